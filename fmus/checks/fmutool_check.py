"""fmutool of the FMU Manipulation Toolbox: conformity and semantic checks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from fmus import CheckError
from fmus.checks.outcome import require


def conformity(fmu: Path) -> str:
    """`fmutool -check` must log neither an error nor a warning."""
    require("fmu_manipulation_toolbox", "fmu-manipulation-toolbox")
    program = "from fmu_manipulation_toolbox.cli.fmutool import fmutool; fmutool()"
    command = [sys.executable, "-c", program, "-input", str(fmu), "-check"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    output = result.stdout + result.stderr
    bad = [
        line for line in output.splitlines() if line.startswith(("ERROR", "WARNING", "CRITICAL"))
    ]
    if result.returncode != 0 or bad:
        raise CheckError("; ".join(bad) or f"fmutool ended with code {result.returncode}")
    found = [line.split("|")[-1].strip() for line in output.splitlines() if "compliant" in line]
    return " ".join(found) or "no problem found"
