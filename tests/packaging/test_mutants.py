"""The one-line faults that `python -m benchmarks.mutants` applies: each can be applied."""

import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from benchmarks.mutants import CHECKOUT, MUTANTS, MutantError, load

MUTANT = """\
[[mutant]]
name = "one"
file = "cosim/core/statistics.py"
old = {old!r}
new = "pass"
group = "statistics"
breaks = "nothing"
"""


@pytest.mark.parametrize("mutant", load(), ids=lambda mutant: mutant.name)
def test_each_changes_one_line_of_python_or_c_and_names_tests_that_exist(mutant):
    text = mutant.mutated(CHECKOUT)
    before = (CHECKOUT / mutant.file).read_text("utf-8")
    pairs = zip(before.splitlines(), text.splitlines(), strict=True)
    assert sum(one != other for one, other in pairs) == 1
    if mutant.file.endswith(".py"):
        compile(text, mutant.file, "exec")
    for test in mutant.tests:
        assert (CHECKOUT / test.partition("::")[0]).is_file()


def test_there_are_enough_of_each_kind():
    mutants = load()
    groups = Counter(mutant.group for mutant in mutants)
    names = {mutant.name for mutant in mutants}
    assert len(mutants) >= 40
    assert {f"M{number}" for number in range(1, 23)} <= names
    learning = [m for m in mutants if m.file.startswith(("learning/", "cosim/stud", "cosim/stat"))]
    assert len(learning) >= len(mutants) / 2
    assert groups["headline"] >= 10


@pytest.mark.parametrize(("old", "times"), [("no such line", 0), ("return", 2)])
def test_a_line_that_is_not_there_once_is_an_error_of_one_line(tmp_path, old, times):
    file = tmp_path / "mutants.toml"
    file.write_text(MUTANT.format(old=old))
    command = [sys.executable, "-m", "benchmarks.mutants", "--list", "--file", file]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: mutant one: ")
    assert "not once" in line


def test_a_field_that_is_unknown_or_missing_is_named(tmp_path):
    file = tmp_path / "mutants.toml"
    file.write_text(MUTANT.format(old="x") + 'color = "red"\n')
    with pytest.raises(MutantError, match="color"):
        load(file)


def test_the_file_is_beside_the_command():
    assert Path("benchmarks/mutants.toml") == MUTANTS.relative_to(CHECKOUT)
