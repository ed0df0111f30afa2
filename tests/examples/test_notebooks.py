"""The notebook-style scripts run from the first cell to the last, on small budgets."""

import re
from pathlib import Path

import pytest
from matplotlib.figure import Figure

NOTEBOOKS = Path(__file__).parents[2] / "examples" / "notebooks"
SMALLER = {"SAMPLES": "1000", "SEEDS, STEPS": "2, 50"}
RESULTS = {
    "train": ("notebook-train/learning.png", "notebook-train/parameters.toml"),
    "evaluate": ("notebook-evaluate/evaluation.csv", "notebook-evaluate/evaluation.png"),
    "study": ("notebook-study/report.html", "notebook-study/summary.csv"),
}


def smaller(text):
    for name, value in SMALLER.items():
        text = re.sub(rf"^{name} = .*$", f"{name} = {value}", text, flags=re.MULTILINE)
    return text.replace("steps=200", "steps=20")


def test_every_script_has_cells_and_a_test():
    scripts = {path.stem: path.read_text() for path in NOTEBOOKS.glob("*.py")}
    assert set(scripts) == set(RESULTS)
    for text in scripts.values():
        assert text.count("\n# %% ") >= 3
        assert smaller(text) != text


@pytest.mark.slow
@pytest.mark.parametrize("name", list(RESULTS))
def test_a_script_runs_cell_by_cell(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    namespace = {"__name__": "notebook"}
    text = smaller((NOTEBOOKS / f"{name}.py").read_text())
    for cell in re.split(r"^# %%.*$", text, flags=re.MULTILINE):
        exec(compile(cell, name, "exec"), namespace)
    assert all((tmp_path / file).stat().st_size > 100 for file in RESULTS[name])
    if name != "study":
        result = namespace.get("training", namespace.get("table"))
        assert isinstance(result.figure(), Figure)
