"""Fenced code blocks of a Markdown page, and how each kind is executed."""

import contextlib
import doctest
import importlib
import importlib.util
import io
import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
import warnings
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

from tests.helpers.command import run_here

ROOT = Path(__file__).parents[2]
FENCE = re.compile(r"^```(\w*)[ ]*([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TITLE = re.compile(r'title="([^"]+)"')
# Not typed by a test of its page, because another check does it or a person has to be there.
COVERED = {
    "cosim demo --out demo": "minutes; `make check` runs it on a small budget",
    "git clone REPOSITORY rti-cosim && cd rti-cosim": "no public address is known",
    "python3 -m venv .venv && . .venv/bin/activate": (
        "tests/packaging installs into an empty environment"
    ),
    "pip install -c constraints.txt '.[view]'": (
        "tests/packaging installs the wheel into an empty environment"
    ),
    "cosim view before/run.rrd": "opens a window; tests/cosim/recording/test_viewer.py draws it",
    "cosim optimum --scenario paper": "minutes; tests/cosim/cli/test_optimum.py",
    "cosim reproduce --budget quick": "minutes; tests/cosim/studies/test_stored.py",
}
# Done with a smaller budget than the page's, which is meant for a reader with time: each step is
# done and feeds the next one. What comes out of a whole budget has its own tests.
SMALLER = {
    "--seeds 3 --steps 1000": "--seeds 2 --steps 200",
    "--seeds 4 --steps 500": "--seeds 2 --steps 300",
    "500 samples × 4 seeds": "300 samples × 2 seeds",
    "--samples 10000": "--samples 4000",
    "--samples 1440": "--samples 120 --set coarse_rollout=600 --set fine_rollout=900",
    "--start cautious --out learned\n": (
        "--start cautious --out learned --set coarse_rollout=600 --set fine_rollout=900\n"
    ),
    '"fouled", 10_000, seed=0': '"fouled", 4000, seed=0',
    '"fouled", 2000, start=': '"fouled", 1000, start=',
    "\nsamples = 1000\n": "\nsamples = 200\n",
    "training_seeds = { first = 0, count = 2 }": "training_seeds = { first = 0, count = 1 }",
    "log_every = 250 }": "log_every = 50 }",
}
SLOW = {"README.md"}
# These search by long simulations: a reader's compiler, which optimises, is worth its time.
SEARCHES = {"your-plant.md"}
CHECKER = doctest.OutputChecker()
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


@dataclass(frozen=True)
class Block:
    """A block's language, options after it, text, and its line on the page."""

    language: str
    options: str
    text: str
    line: int


def pages() -> list[Path]:
    """README, every page of docs/, and the pages beside code."""
    beside = ["README.md", "CONTRIBUTING.md", "examples/teaching.md"]
    return [*(ROOT / name for name in beside), *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order, with the tests' budgets."""
    text = page.read_text()
    return [
        Block(match[1], match[2], with_less(match[3]), text[: match.start()].count("\n") + 1)
        for match in FENCE.finditer(text)
    ]


def with_less(text: str) -> str:
    """A block's text with the budgets of `SMALLER`."""
    for budget, smaller in SMALLER.items():
        text = text.replace(budget, smaller)
    return text


def is_slow(page: Path) -> bool:
    """Whether the page says that it takes long."""
    return page.name in SLOW or page.read_text().startswith("<!-- slow -->")


class Session:
    """One reader who follows a page from top to bottom in a folder."""

    def __init__(self, page: Path, folder: Path) -> None:
        self.page, self.folder = page, folder
        self.namespace: dict[str, object] = {"__name__": "page"}
        self.commands = 0
        self.printed = ""  # by the Python block before
        self.environment = os.environ | {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        }
        if page.name in SEARCHES:
            self.environment.pop("CC", None)
        for needed in re.findall(r"<!-- needs (\S+) -->", page.read_text()):
            (folder / needed).parent.mkdir(parents=True, exist_ok=True)
            (folder / needed).symlink_to(ROOT / needed)

    def follow(self, block: Block) -> None:
        """Execute a block as its language asks; raises AssertionError where it does not hold."""
        kind = block.language
        where = f"{self.page.relative_to(ROOT)}:{block.line}"
        if title := TITLE.search(block.options):
            (self.folder / title[1]).write_text(block.text)
        if kind == "python" and title:
            importlib.import_module(title[1].removesuffix(".py"))
        elif kind == "python":
            first = re.match(r"import (torch|jax)$", block.text, re.MULTILINE)
            if first and importlib.util.find_spec(first[1]) is None:
                return  # an extra that is not there
            code = compile("\n" * block.line + block.text, where, "exec", dont_inherit=True)
            printed = io.StringIO()
            with warnings.catch_warnings(), contextlib.redirect_stdout(printed):
                warnings.simplefilter("error")
                exec(code, self.namespace)
            self.printed = printed.getvalue()
        elif kind == "text" and block.options == "output":
            fits = CHECKER.check_output(block.text, self.printed, FLAGS)
            assert fits, f"{where}: expected\n{block.text}\ngot\n{self.printed}"
        elif kind == "console":
            self._type(block.text, where)
        elif kind == "toml":
            tomllib.loads(block.text)
        elif kind == "json":
            json.loads(block.text)
        elif kind not in ("text", "bibtex", "c"):
            raise AssertionError(f"{where}: nothing here executes a block of '{kind}'")

    def _type(self, text: str, where: str) -> None:
        """Run each `$ ` line in a shell; the lines below it are what it must print.

        A command goes on in the next line after a backslash.
        """
        for part in re.split(r"^\$ ", text.replace("\\\n", ""), flags=re.MULTILINE)[1:]:
            line, _, expected = part.partition("\n")
            command, _, comment = line.partition(" # ")
            command = command.strip()
            if command in COVERED:
                continue
            code = re.search(r"exit code (\d+)", comment)
            returned, said = self._run(command)
            assert returned == (int(code[1]) if code else 0), f"{where}: {line}\n{said}"
            self.commands += 1
            if expected.strip():
                fits = CHECKER.check_output(expected, said, FLAGS)
                assert fits, f"{where}: {line}\nexpected\n{expected}\ngot\n{said}"

    def _run(self, command: str) -> tuple[int, str]:
        """Exit code and text of a command; a plain `cosim` runs in this process, loaded already."""
        if command.startswith("cosim ") and not set(command) & set("|<>;&*$"):
            with mock.patch.dict(os.environ, self.environment, clear=True):
                result = run_here(*shlex.split(command)[1:])
        else:
            result = subprocess.run(
                command,
                shell=True,
                cwd=self.folder,
                env=self.environment,
                capture_output=True,
                text=True,
                check=False,
            )
        return result.returncode, result.stdout + result.stderr
