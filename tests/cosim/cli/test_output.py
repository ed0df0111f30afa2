import os
import subprocess
import sys


def test_a_reader_who_leaves_hears_nothing():
    reading, writing = os.pipe()
    os.close(reading)
    words = [sys.executable, "-m", "cosim", "train", "--help"]
    with os.fdopen(writing, "w") as closed:
        ended = subprocess.run(words, stdout=closed, stderr=subprocess.PIPE, check=False)
    assert (ended.returncode, ended.stderr) == (141, b"")
