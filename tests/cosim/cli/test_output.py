import io
import os
import re
import subprocess
import sys

import pytest
import rich.console

from cosim.cli.output import Output

HEADER, ROW = ("a heading", "b" * 30, "c"), ("x" * 40, "y", "z" * 40)


@pytest.fixture
def printed(monkeypatch):
    """The table as printed to a terminal of 60 columns, or to a file."""

    def text(terminal, title="title", header=HEADER, rows=(ROW,)):
        stream = io.StringIO()
        console = rich.console.Console(file=stream, force_terminal=terminal, width=60)
        monkeypatch.setattr(rich.console, "Console", lambda: console)
        Output(False).table(title, header, rows)
        return stream.getvalue()

    return text


def test_a_file_gets_every_cell_whole(printed):
    text = printed(terminal=False)
    assert [cell for cell in (*HEADER, *ROW) if cell not in text] == []


def test_numbers_are_never_broken_on_a_narrow_terminal(printed):
    rows = [("actor-critic", *(f"{k}234.56 [1.23, 4.56]" for k in range(1, 8)))]
    text = printed(True, "t", ("case", *(f"regret {k}" for k in range(7))), rows)
    plain = re.sub(r"\x1b\[[0-9;]*m", "", text)
    assert max(map(len, plain.splitlines())) <= 60
    assert all(cell in text for cell in rows[0])


def test_brackets_are_text(printed):
    text = printed(False, "a[b]", ("c[red]",), [("pip install 'rti-cosim[cluster]'",)])
    assert "a[b]" in text
    assert "c[red]" in text
    assert "'rti-cosim[cluster]'" in text


def test_a_reader_who_leaves_hears_nothing():
    reading, writing = os.pipe()
    os.close(reading)
    words = [sys.executable, "-m", "cosim", "train", "--help"]
    with os.fdopen(writing, "w") as closed:
        ended = subprocess.run(words, stdout=closed, stderr=subprocess.PIPE, check=False)
    assert (ended.returncode, ended.stderr) == (141, b"")
