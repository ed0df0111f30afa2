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
