"""One-line faults, and what catches each: `python -m benchmarks.mutants [NAME ...]`.

Each mutant of mutants.toml is one line of the package, changed so that it computes something else.
It is applied to a copy of the checkout; then its own tests run, then the fast suite, then
`cosim results check`, until one of them fails. What no check catches survives. The copy's packages
are imported, its C files compiled: the tests that compare the sources' hash with the stored builds'
are left out, since any edit would fail them.

Exit code 1 where less than `LEAST` are caught, or one of the headline survives; 2 where a mutant
cannot be applied.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

CHECKOUT = Path(__file__).parents[1]
MUTANTS = Path(__file__).with_suffix(".toml")
GROUPS = ("core", "learning", "studies", "statistics", "headline")
STAGES = ("tests", "suite", "check")
LEAST = 0.9
"""Share of the mutants that must be caught."""
FAILS_FOR_ANY_EDIT = (
    "tests/controllers/test_compilation.py::test_a_stored_build_gives_the_compilers_bytes",
    "tests/controllers/test_compilation.py::test_the_stored_builds_are_those_of_the_presets",
    "tests/packaging/test_mutants.py",
)
"""Tests that notice a change of the sources, whatever it is."""
SECONDS = {"tests": 900, "suite": 3600, "check": 1800}
"""Time that a stage may take: a mutant that does not end is caught."""


class MutantError(Exception):
    """A mutant that cannot be applied, or a checkout whose own tests fail."""


@dataclass(frozen=True)
class Mutant:
    """A line `old` of a `file`, replaced by `new`; `breaks` says what is wrong then.

    `tests` are tried first. One of `groups` must be its `group`.
    """

    name: str
    file: str
    old: str
    new: str
    group: str
    breaks: str
    tests: tuple[str, ...] = ()

    def mutated(self, root: Path) -> str:
        """The file's text with the fault; raises MutantError unless `old` is there exactly once."""
        path = root / self.file
        if not path.is_file():
            raise MutantError(f"mutant {self.name}: there is no file '{self.file}'")
        text = path.read_text("utf-8")
        times = text.count(self.old)
        if times != 1:
            raise MutantError(
                f"mutant {self.name}: {self.old!r} is {times} times in '{self.file}', not once"
            )
        if "\n" in self.old or "\n" in self.new:
            raise MutantError(f"mutant {self.name}: a mutation is of one line")
        return text.replace(self.old, self.new)


def load(path: Path = MUTANTS) -> list[Mutant]:
    """The mutants of a TOML file; raises MutantError on a wrong field, group or name."""
    known = set(Mutant.__dataclass_fields__)
    mutants: list[Mutant] = []
    for table in tomllib.loads(path.read_text("utf-8"))["mutant"]:
        name = table.get("name", "without a name")
        if wrong := sorted((set(table) | {"tests"}) ^ known):
            raise MutantError(f"mutant {name}: missing or unknown: {', '.join(wrong)}")
        mutant = Mutant(**{**table, "tests": tuple(table.get("tests", ()))})
        if mutant.group not in GROUPS:
            raise MutantError(f"mutant {name}: group '{mutant.group}' is none of {GROUPS}")
        if any(mutant.name == other.name for other in mutants):
            raise MutantError(f"two mutants are called '{mutant.name}'")
        mutants.append(mutant)
    return mutants


class Copy:
    """A copy of the checkout, with the environment in which its own packages are imported."""

    def __init__(self, root: Path) -> None:
        self.root = root
        listed = subprocess.run(
            ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"],
            cwd=CHECKOUT,
            capture_output=True,
            check=True,
        )
        for name in listed.stdout.decode().split("\0"):
            source, target = CHECKOUT / name, root / name
            if name and source.is_file():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(source, target)
        self.environment = {
            **os.environ,
            "PYTHONPATH": str(root),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        # The tests have a cache of their own in each session.
        for name in ("COSIM_COMPILE", "COSIM_CACHE"):
            self.environment.pop(name, None)
        where = self.python("-c", "import cosim; print(cosim.__file__)", seconds=120).stdout
        if not where.startswith(str(root)):
            raise MutantError(f"cosim would be imported from {where.strip()}, not from the copy")

    def python(self, *arguments: str, seconds: float) -> subprocess.CompletedProcess[str]:
        """Run this Python in the copy; a timeout has the exit code 124."""
        command = [sys.executable, *arguments]
        try:
            return subprocess.run(
                command,
                cwd=self.root,
                env=self.environment,
                capture_output=True,
                text=True,
                timeout=seconds,
                check=False,
            )
        except subprocess.TimeoutExpired:
            return subprocess.CompletedProcess(command, 124, "", "")

    def caught_by(self, stage: str, mutant: Mutant | None, jobs: int) -> str:
        """The test or check that fails in a stage; "" where all pass.

        `mutant` says which tests are its own; without one the stage runs on the checkout as it is.
        """
        if stage == "check":
            return self._results_check(jobs)
        chosen = mutant.tests if stage == "tests" and mutant is not None else ("tests",)
        if not chosen:
            return ""
        options = ["-x", "-q", "-p", "no:cacheprovider", "--no-header", "-rf", "--tb=no"]
        if stage == "suite":
            options += ["-n", str(jobs)]
        for name in FAILS_FOR_ANY_EDIT:
            options += ["--deselect", name]
        done = self.python("-m", "pytest", *options, *chosen, seconds=SECONDS[stage])
        if done.returncode == 0:
            return ""
        if done.returncode == 124:
            return f"{stage}: does not end"
        failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
        if not failed:
            raise MutantError(
                f"pytest said: {' '.join((done.stdout + done.stderr).split())[-300:]}"
            )
        return failed[0].partition(" ")[2].partition(" - ")[0]

    def _results_check(self, jobs: int) -> str:
        # Libraries are kept by their content; the key of a solved optimum does not know our code.
        cache = self.root.parent / "cache"
        self.environment["COSIM_CACHE"] = str(cache)
        shutil.rmtree(cache / "optima", ignore_errors=True)
        command = ["-m", "cosim", "results", "check", "--results", "results", "--json"]
        done = self.python(*command, "--jobs", str(jobs), seconds=SECONDS["check"])
        del self.environment["COSIM_CACHE"]
        if done.returncode == 0:
            return ""
        if done.returncode == 1:
            try:
                found = json.loads(done.stdout)["differences"]
                first = next(lines[0] for lines in found.values() if lines)
                return f"results check: {first}"
            except (ValueError, KeyError, StopIteration):
                pass
        return f"results check: exit code {done.returncode}"


def tried(
    mutant: Mutant, copy: Copy, stages: Sequence[str], sound: dict[str, str], jobs: int
) -> str:
    """What catches a mutant; "" where it survives all stages.

    `sound` keeps what each stage says of the checkout as it is: it must pass there.
    """
    text = mutant.mutated(copy.root)
    path = copy.root / mutant.file
    before = path.read_text("utf-8")
    for stage in stages:
        key = " ".join([stage, *(mutant.tests if stage == "tests" else ())])
        if key not in sound:
            sound[key] = copy.caught_by(stage, mutant, jobs)
        if sound[key]:
            raise MutantError(f"without any mutant '{sound[key]}' fails")
        path.write_text(text, "utf-8")
        try:
            caught = copy.caught_by(stage, mutant, jobs)
        finally:
            path.write_text(before, "utf-8")
        if caught:
            return caught
    return ""


def main() -> int:
    """Try the mutants, print a table, and return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.mutants", description=__doc__)
    parser.add_argument("names", nargs="*", help="mutants; default: all")
    parser.add_argument("--group", choices=GROUPS, action="append", help="only these groups")
    parser.add_argument("--stages", default=",".join(STAGES), help="of tests,suite,check")
    parser.add_argument("--file", type=Path, default=MUTANTS, help="another TOML file")
    parser.add_argument("--list", action="store_true", help="apply each, run nothing")
    parser.add_argument("--jobs", type=int, default=2, help="processes of suite and check")
    options = parser.parse_args()
    try:
        mutants = load(options.file)
        unknown = set(options.names) - {mutant.name for mutant in mutants}
        if unknown:
            raise MutantError(f"there is no mutant '{sorted(unknown)[0]}'")
        if options.names:
            mutants = [mutant for mutant in mutants if mutant.name in options.names]
        if options.group:
            mutants = [mutant for mutant in mutants if mutant.group in options.group]
        for mutant in mutants:
            mutant.mutated(CHECKOUT)
        if options.list:
            for mutant in mutants:
                print(f"{mutant.name:6} {mutant.group:11} {mutant.file}: {mutant.breaks}")
            return 0
        return _table(mutants, options.stages.split(","), options.jobs)
    except (MutantError, OSError, tomllib.TOMLDecodeError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def _table(mutants: Sequence[Mutant], stages: Sequence[str], jobs: int) -> int:
    """Print a row for each mutant as it is tried; the exit code."""
    survivors: list[Mutant] = []
    sound: dict[str, str] = {}
    with tempfile.TemporaryDirectory(prefix="cosim-mutants-") as folder:
        copy = Copy(Path(folder) / "checkout")
        print("| mutant | group | what it breaks | caught by | s |\n|---|---|---|---|---:|")
        for mutant in mutants:
            begin = time.perf_counter()
            caught = tried(mutant, copy, stages, sound, jobs)
            if not caught:
                survivors.append(mutant)
            seconds = f"{time.perf_counter() - begin:.0f}"
            row = (mutant.name, mutant.group, mutant.breaks, caught or "SURVIVES", seconds)
            print(f"| {' | '.join(row)} |", flush=True)
    number = len(mutants) - len(survivors)
    print(
        f"\n{number} of {len(mutants)} caught; {', '.join(m.name for m in survivors)}".rstrip("; ")
    )
    headline = any(mutant.group == "headline" for mutant in survivors)
    return 1 if headline or number < LEAST * len(mutants) else 0


if __name__ == "__main__":
    sys.exit(main())
