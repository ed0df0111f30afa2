"""The notebooks are stored executed, with pictures, and run from the first cell to the last."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[2] / "examples" / "notebooks"
SMALLER = {
    "4000": "1000",
    "2000": "400",
    "steps=300": "steps=20",
    '"count": 2': '"count": 1',
    # Searched for by long simulations, once, in `train`.
    '["naive", "backed-off"]': '["naive", "tuned"]',
    '"start": "backed-off"': '"start": "tuned"',
}
NAMES = ("evaluate", "sensors", "study", "train")


def read(name):
    return nbformat.read(NOTEBOOKS / f"{name}.ipynb", as_version=4)


def code(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_stored_with_its_pictures(name):
    notebook = read(name)
    nbformat.validate(notebook)
    assert all(cell.outputs for cell in code(notebook))
    shown = [output.get("data", {}) for cell in code(notebook) for output in cell.outputs]
    assert any("image/png" in data or "data:image/png" in str(data) for data in shown)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs_cell_by_cell(name, tmp_path, monkeypatch):
    # Python 3.13.0 warns when ipykernel starts.
    monkeypatch.setenv("PYTHONWARNINGS", "error,ignore:There is no current event loop")
    notebook = read(name)
    for cell in code(notebook):
        for size, smaller in SMALLER.items():
            cell.source = cell.source.replace(size, smaller)
    NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(tmp_path)}}).execute()
