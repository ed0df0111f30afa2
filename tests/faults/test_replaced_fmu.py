"""An FMU replaced during a run: the run keeps to the old one or says so; none mixes two."""

import shutil

import pytest

import fmus
from cosim import Scenario, evaluate
from cosim.core.errors import EvaluationError, PlantError
from tests.helpers.loop import Proportional


@pytest.fixture
def scenario(tmp_path):
    """`paper` with an FMU of its own."""
    path = tmp_path / "plant.fmu"
    shutil.copy(fmus.path("evaporator"), path)
    return Scenario.load("paper").replace({"plant": {"fmu": str(path)}})


def test_an_evaluation_ends_in_a_line_and_writes_nothing(scenario, tmp_path, monkeypatch):
    monkeypatch.setattr("cosim.evaluation.ITEM_SAMPLES", 20)  # an item a seed
    runs = []

    def counting(described):
        controller = Proportional(described)
        reset = controller.reset

        def note():
            runs.append(1)
            if len(runs) == 3:
                shutil.copy(fmus.path("evaporator_fmi3"), scenario.plant.fmu)
            reset()

        controller.reset = note
        return controller

    with pytest.raises((EvaluationError, PlantError)) as caught:
        evaluate(scenario, {"p": counting}, 6, 20, folder=tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())
    assert str(scenario.plant.fmu) in str(caught.value)
    assert "\n" not in str(caught.value)
