"""Standard streams that are closed, full, or cannot encode what is printed: never a traceback."""

import os
import subprocess
import sys

import pytest

COMMAND = [sys.executable, "-m", "cosim"]
ASCII = {"PYTHONIOENCODING": "ascii", "LC_ALL": "C", "PYTHONUTF8": "0"}
WORDS = {"a table with Greek letters": ["scenario"], "an error with one": ["scenario", "θ.toml"]}
CODES = {"a table with Greek letters": 0, "an error with one": 2}
pytestmark = pytest.mark.skipif(os.name == "nt", reason="descriptors of POSIX")


def shell(tmp_path, words, redirection, environment=None):
    line = " ".join(f"'{word}'" for word in [*COMMAND, *words])
    return subprocess.run(
        ["/bin/sh", "-c", f"{line} {redirection}"],
        cwd=tmp_path,
        env=os.environ | (environment or {}),
        capture_output=True,
        check=False,
    )


@pytest.mark.parametrize("kind", WORDS)
def test_what_an_encoding_lacks_is_escaped(tmp_path, kind):
    done = shell(tmp_path, WORDS[kind], "", ASCII)
    assert done.returncode == CODES[kind], done.stderr
    assert b"Traceback" not in done.stderr
    done.stdout.decode("ascii")
    done.stderr.decode("ascii")


@pytest.mark.slow
@pytest.mark.parametrize("redirection", ["<&- >&- 2>&-", "> /dev/full", "| true"])
def test_a_stream_that_cannot_be_written_ends_in_no_traceback(tmp_path, redirection):
    done = shell(tmp_path, ["scenario"], redirection)
    assert b"Traceback" not in done.stderr
    assert (done.returncode != 0) is ("full" in redirection), done.stderr
