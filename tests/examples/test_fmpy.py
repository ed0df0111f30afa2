"""The scripts that drive the FMU with fmpy alone run as their docstrings say."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"


def run(*arguments: str) -> str:
    command = [sys.executable, *arguments]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    return result.stdout


def test_scripts_import_nothing_of_ours() -> None:
    for script in EXAMPLES.glob("fmpy_*.py"):
        imports = re.findall(r"^(?:from|import) (\w+)", script.read_text(), flags=re.MULTILINE)
        assert set(imports) - sys.stdlib_module_names <= {"fmpy", "numpy"}


def test_simulate_gives_the_same_for_both_fmi_versions() -> None:
    texts = [
        run("examples/fmpy_simulate.py", f"fmus/{name}.fmu", "examples/fmpy_inputs.csv")
        for name in ("evaporator", "evaporator_fmi3")
    ]
    lines = [re.findall(r"^(.*): mean cost ([\d.]+), X2 below", t, re.MULTILINE) for t in texts]
    assert lines[0] == lines[1]
    labels = [label for label, _ in lines[0]]
    assert labels == ["nominal", "seed 1", "seed 2", "seed 3, normal law"]
    costs = [float(cost) for _, cost in lines[0]]
    assert len(set(costs)) == 4
    assert all(6000.0 < cost < 7500.0 for cost in costs)


def test_loop_repeats_its_samples_after_the_restore() -> None:
    text = run("examples/fmpy_loop.py", "fmus/evaporator.fmu")
    assert "restored samples are identical" in text
    (cost,) = re.findall(r"mean cost ([\d.]+)", text)
    assert float(cost) == pytest.approx(6300.0, rel=0.05)
