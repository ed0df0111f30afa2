"""Every row of a table "proved by" names a command, and every command selects something to run."""

import json
import re
import shlex
import subprocess
import sys

import pytest

from tests.helpers.code_blocks import ROOT, pages

HEADER = "| proved by |"
# What a page writes for the sake of its table's width.
SHORT = {"PROOF": "python -m pytest tests/faults", "tests": "python -m pytest tests"}


def rows():
    """Page, row and commands of each row of each such table."""
    for page in pages():
        inside = False
        for line in page.read_text().splitlines():
            if line.endswith(HEADER):
                inside = True
            elif inside and not line.startswith("|"):
                inside = False
            elif inside and not line.startswith("|---"):
                yield page.name, line, re.findall(r"`([^`]+)`", line.rsplit("|", 2)[1])


def commands():
    for _, _, found in rows():
        for command in found:
            first = re.match(r"\w+", command)[0]
            yield SHORT.get(first, first) + command.removeprefix(first)


def test_every_row_names_a_proof():
    assert {page for page, _, _ in rows()} >= {
        "inputs.md",
        "faults.md",
        "security.md",
        "packaging.md",
    }
    assert [(page, row) for page, row, found in rows() if not found] == []


COLLECT = """
import json, sys, pytest
for words in json.loads(sys.argv[1]):
    code = pytest.main([*words, "--collect-only", "-q", "-p", "no:cacheprovider"])
    print("EXIT", int(code))
"""


@pytest.mark.slow
def test_every_proof_selects_something():
    proofs = sorted(set(commands()))
    tests, scripts = [], []
    for words in map(shlex.split, proofs):
        assert words[0] == "python"
        if words[1:3] == ["-m", "pytest"]:
            tests.append(words[3:])
        else:
            module = f"{words[2].replace('.', '/')}.py" if words[1] == "-m" else words[1]
            scripts.append(module)
    assert all((ROOT / script).is_file() for script in scripts)
    # One process for all, or each would import everything anew.
    result = subprocess.run(
        [sys.executable, "-c", COLLECT, json.dumps(tests)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    parts = result.stdout.split("EXIT ")
    assert len(parts) == len(tests) + 1, result.stdout + result.stderr
    for words, part, after in zip(tests, parts, parts[1:], strict=False):
        assert after[0] == "0", f"{words}\n{part}"
        assert "::test_" in part, words
