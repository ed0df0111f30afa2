import io

import pytest
import rich.console

from cosim.cli.output import Output

HEADER, ROW = ("a heading", "b" * 30, "c"), ("x" * 40, "y", "z" * 40)


@pytest.fixture
def printed(monkeypatch):
    """The table as printed to a terminal of 60 columns, or to a file."""

    def text(terminal):
        stream = io.StringIO()
        console = rich.console.Console(file=stream, force_terminal=terminal, width=60)
        monkeypatch.setattr(rich.console, "Console", lambda: console)
        Output(False).table("title", HEADER, [ROW])
        return stream.getvalue()

    return text


def test_a_file_gets_every_cell_whole(printed):
    text = printed(terminal=False)
    assert [cell for cell in (*HEADER, *ROW) if cell not in text] == []


def test_a_narrow_terminal_gets_folded_cells_without_loss(printed):
    text = printed(terminal=True)
    assert "…" not in text
    assert [text.count(letter) for letter in "xz"] == [40, 40]
