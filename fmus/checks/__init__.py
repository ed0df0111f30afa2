"""Run every independent importer that is installed on an FMU, each in a process of its own."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from fmus import FmuError
from fmus.checks import casadi_check, ecospy_check, fmpy_check, fmutool_check, libcosimpy_check
from fmus.checks.outcome import NotedError, NotInstalledError, NotOfferedError
from fmus.information import description_of

TIMEOUT = 300.0  # s for one importer
JUDGES = ("fmpy", "fmutool")
WORDS = 200  # last characters of what a crashed importer said


class Status(StrEnum):
    """What came of one check.

    `FAILED` says that the FMU is wrong; `CANNOT` that the importer does not do with it what
    others do; `NOTED` what is worth knowing and no fault.
    """

    PASSED = "passed"
    FAILED = "failed"
    NOTED = "noted"
    CANNOT = "importer cannot"
    NOT_INSTALLED = "not installed"
    NOT_OFFERED = "not offered"


@dataclass(frozen=True)
class Finding:
    """One line of the table: which tool looked at what, and what it found."""

    tool: str
    subject: str
    status: Status
    detail: str


# (tool, subject) → a function that returns a detail, or raises CheckError, NotInstalledError, …
CHECKS: dict[tuple[str, str], Callable[[Path], str]] = {
    ("fmpy", "validation"): fmpy_check.validate,
    ("fmpy", "declared variables"): fmpy_check.declared_variables,
    ("fmpy", "co-simulation"): fmpy_check.co_simulation,
    ("fmpy", "model exchange, CVode"): fmpy_check.model_exchange,
    ("casadi", "model exchange, Jacobian"): casadi_check.jacobian,
    ("ecospy", "co-simulation"): ecospy_check.co_simulation,
    ("libcosimpy", "co-simulation"): libcosimpy_check.co_simulation,
    ("fmutool", "conformity"): fmutool_check.conformity,
}


def check(fmu: Path) -> list[Finding]:
    """Check the file `fmu` with every importer, in the order of `CHECKS`.

    Raises FmuError when the file is missing or is no FMU.
    """
    description_of(fmu)
    return [_in_own_process(tool, subject, fmu) for tool, subject in CHECKS]


def run(tool: str, subject: str, fmu: Path) -> Finding:
    """Run one check in this process."""
    try:
        detail = CHECKS[tool, subject](fmu)
    except NotInstalledError as error:
        return Finding(tool, subject, Status.NOT_INSTALLED, str(error))
    except NotOfferedError as error:
        return Finding(tool, subject, Status.NOT_OFFERED, str(error))
    except NotedError as error:
        return Finding(tool, subject, Status.NOTED, str(error))
    except FmuError as error:
        return Finding(tool, subject, Status.FAILED, str(error))
    except Exception as error:
        return Finding(tool, subject, _blame(tool), f"{type(error).__name__}: {error}")
    return Finding(tool, subject, Status.PASSED, detail)


def _blame(tool: str) -> Status:
    """What a failure means that the check did not foresee.

    fmpy only passes calls on, so that the FMU made it fail; any other importer may be unable.
    """
    return Status.FAILED if tool in JUDGES else Status.CANNOT


def _in_own_process(tool: str, subject: str, fmu: Path) -> Finding:
    """Native importers write to the console, and one that crashes must not end the others."""
    command = [sys.executable, "-m", "fmus.checks", tool, subject, str(fmu.resolve())]
    try:
        result = subprocess.run(
            command, capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return Finding(tool, subject, _blame(tool), f"no result after {TIMEOUT:.0f} s")
    lines = result.stdout.splitlines()
    if result.returncode != 0 or not lines:
        words = " ".join(result.stderr.split())[-WORDS:]
        detail = f"the process ended with code {result.returncode}: {words}"
        return Finding(tool, subject, _blame(tool), detail)
    status, detail = json.loads(lines[-1])
    return Finding(tool, subject, Status(status), detail)
