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


@pytest.mark.slow
@pytest.mark.parametrize("kind", WORDS)
@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_closed_stream_ends_in_no_traceback(tmp_path, kind, closed):
    done = shell(tmp_path, WORDS[kind], closed)
    assert done.returncode == CODES[kind], done.stderr
    assert b"Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")  # noqa: PTH110
@pytest.mark.parametrize("kind", ["table", "document", "help"])
def test_a_full_device_is_a_line(tmp_path, kind):
    done = shell(tmp_path, WORDS[kind], "> /dev/full")
    assert done.returncode != 0
    assert b"Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["table", "document", "help"])
def test_a_reader_that_goes_away_is_no_traceback(tmp_path, kind):
    done = shell(tmp_path, WORDS[kind], "| true")
    assert b"Traceback" not in done.stderr
