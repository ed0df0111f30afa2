"""Fenced code blocks of a Markdown page, and how each kind is executed."""

import doctest
import importlib
import importlib.util
import json
import os
import re
import subprocess
import sys
import tomllib
import warnings
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
FENCE = re.compile(r"^```(\w*)[ ]*([^\n]*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
TITLE = re.compile(r'title="([^"]+)"')
# Not typed by a test of its page, because another check does it or a person has to be there.
COVERED = {
    "make demo": "the Makefile's target; `make check` runs its command on a small budget",
    "cosim demo --out demo": "minutes; `make check` runs it on a small budget",
    "make test": "the target is run by .ci/run",
    "python3 -m venv .venv": "tests/packaging installs into an empty environment",
    ". .venv/bin/activate": "tests/packaging installs into an empty environment",
    "pip install .": "tests/packaging installs the wheel into an empty environment",
    "pip install '.[cluster]'": "installed by `make test`",
    "cosim view demo/run.rrd": "opens a window; tests/cosim/recording/test_viewer.py draws it",
    "cosim view run/run.rrd": "opens a window; tests/cosim/recording/test_viewer.py draws it",
    "cosim optimum --scenario paper": "minutes; tests/cosim/cli/test_optimum.py",
    "cosim reproduce --budget quick": "minutes; tests/cosim/studies/test_stored.py",
    "cosim export trained/parameters.toml --scenario fouled --out controller.fmu": (
        "compiles for every platform; docs/how-to/deploy.md types it with --local"
    ),
    "cosim study run study.toml --out study": "a synopsis; docs/how-to/study.md",
    "cosim study report study": "a synopsis; docs/how-to/study.md",
    "cosim compare run other-run": "a synopsis; tests/cosim/cli/test_compare.py",
    "cosim fmu info|check|build": "a synopsis; tests/cosim/cli/test_fmu.py",
    "cosim results check|update|draw": "a synopsis; tests/cosim/studies/test_stored.py",
}
# Typed with a smaller budget than the page's, which is meant for a reader with time.
SMALLER = {
    "naive,tuned,optimal,": "naive,tuned,",
    "--seeds 20 --steps 1000": "--seeds 2 --steps 100",
    "--samples 40000": "--samples 5000",
    "--samples 1440": "--samples 300",
}
SLOW = {"scenario.md", "fmpy.md", "README.md"}
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
    """README and every page of docs/."""
    return [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text()
    return [
        Block(match[1], match[2], match[3], text[: match.start()].count("\n") + 1)
        for match in FENCE.finditer(text)
    ]


def is_slow(page: Path) -> bool:
    """Whether the page says that it takes long."""
    return page.name in SLOW or page.read_text().startswith("<!-- slow -->")


class Session:
    """One reader who follows a page from top to bottom in a folder."""

    def __init__(self, page: Path, folder: Path) -> None:
        self.page, self.folder = page, folder
        self.namespace: dict[str, object] = {"__name__": "page"}
        self.commands = 0
        self.environment = os.environ | {
            "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        }
        # Its commands compute for long: with a reader's compiler, not with the tests' quick one.
        if is_slow(page):
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
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                exec(code, self.namespace)
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
            for budget, smaller in SMALLER.items():
                command = command.replace(budget, smaller)
            code = re.search(r"exit code (\d+)", comment)
            result = subprocess.run(
                command,
                shell=True,
                cwd=self.folder,
                env=self.environment,
                capture_output=True,
                text=True,
                check=False,
            )
            said = result.stdout + result.stderr
            assert result.returncode == (int(code[1]) if code else 0), f"{where}: {line}\n{said}"
            self.commands += 1
            if expected.strip():
                fits = CHECKER.check_output(expected, said, FLAGS)
                assert fits, f"{where}: {line}\nexpected\n{expected}\ngot\n{said}"
