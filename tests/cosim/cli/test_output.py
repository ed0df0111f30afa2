import os
import subprocess
import sys

from cosim.cli.output import Output


def test_brackets_are_text(capsys):
    Output(False).table("a[b]", ("c[red]",), [("pip install 'rti-cosim[cluster]'",)])
    text = "".join(capsys.readouterr())
    assert all(part in text for part in ("a[b]", "c[red]", "'rti-cosim[cluster]'"))


def test_a_reader_who_leaves_hears_nothing():
    reading, writing = os.pipe()
    os.close(reading)
    words = [sys.executable, "-m", "cosim", "train", "--help"]
    with os.fdopen(writing, "w") as closed:
        ended = subprocess.run(words, stdout=closed, stderr=subprocess.PIPE, check=False)
    assert (ended.returncode, ended.stderr) == (141, b"")


def test_a_table_fits_its_columns_and_loses_no_word(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    meaning = "what a reader wants to know of it, at some length, " * 3
    header = ("name", "default", "allowed", "meaning")
    rows = [("an_uncommonly_long_name", "[0.1, 0.01]", "list of number > 0 or nothing", meaning)]
    Output(False).table("t", header, rows)
    lines = capsys.readouterr().out.splitlines()
    assert max(len(line) for line in lines) <= 80
    (first,) = [line for line in lines if "an_uncommonly_long_name" in line]
    assert "[0.1, 0.01]" in first and "list of number" in first and "what a reader" in first
    assert "length," in "".join(lines)
