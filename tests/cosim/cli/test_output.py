import io
import os
import subprocess
import sys

import rich.console

from cosim.cli.output import Output


def test_brackets_are_text(monkeypatch):
    stream = io.StringIO()
    console = rich.console.Console(file=stream, width=60)
    monkeypatch.setattr(rich.console, "Console", lambda: console)
    Output(False).table("a[b]", ("c[red]",), [("pip install 'rti-cosim[cluster]'",)])
    text = stream.getvalue()
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
