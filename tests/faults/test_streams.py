"""Standard streams that are closed, full, or cannot encode what is printed: never a traceback."""

import os
import subprocess
import sys

import pytest

COMMAND = [sys.executable, "-m", "cosim"]
ASCII = {"PYTHONIOENCODING": "ascii", "LC_ALL": "C", "PYTHONUTF8": "0"}
# Of a table with Greek letters, of a document, of help, and of an error that has none of ASCII.
WORDS = {
    "table": ["scenario"],
    "document": ["scenario", "--json"],
    "help": ["evaluate", "--help"],
    "error": ["scenario", "θ.toml"],
}
CODES = {"table": 0, "document": 0, "help": 0, "error": 2}
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


REDIRECTIONS = {
    "no output": ">&-",
    "no errors": "2>&-",
    "no stream": "<&- >&- 2>&-",
    "a full device": "> /dev/full",
    "a reader that goes away": "| true",
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", WORDS)
@pytest.mark.parametrize("what", REDIRECTIONS)
def test_a_stream_that_cannot_be_written_ends_in_no_traceback(tmp_path, kind, what):
    done = shell(tmp_path, WORDS[kind], REDIRECTIONS[what])
    assert b"Traceback" not in done.stderr
    if what.startswith("no "):
        assert done.returncode == CODES[kind], done.stderr
    elif what == "a full device":
        assert done.returncode != 0
