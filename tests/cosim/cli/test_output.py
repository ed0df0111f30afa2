import io
import os
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
