import numpy as np
import pytest

from cosim import FmuPlant, simulate
from cosim.errors import RecordingError
from cosim.recording import read_recording
from cosim.recording.showcase import TrainingHistory, record_showcase
from tests.helpers.loop import Proportional


@pytest.fixture
def runs(paper):
    with FmuPlant(paper) as plant:
        return {
            name: simulate(plant, Proportional(paper), steps, 0)
            for name, steps in (("$mine", 20), ("other", 30))
        }


HISTORY = TrainingHistory(
    samples=np.array([0.0, 10.0, 20.0]),
    curves={"regret %": np.array([np.nan, 2.0, 1.0])},
    theta={"x_l": np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.5]])},
    labels={"x_l": ("x_l[0]", "x_l[1]")},
)


def test_runs_of_different_length_and_a_training_are_in_one_file(runs, tmp_path):
    path = tmp_path / "demo.rrd"
    record_showcase(path, runs, HISTORY, "# about")
    signals = read_recording(path).signals
    np.testing.assert_array_equal(signals["other: X2"], runs["other"]["X2"])
    mine = signals["$mine: P100"]
    np.testing.assert_array_equal(mine[: len(runs["$mine"]["P100"])], runs["$mine"]["P100"])
    assert {"regret %", "x_l[0]", "x_l[1]"} <= set(signals)
    assert [file.name for file in tmp_path.iterdir()] == ["demo.rrd"]


def test_a_folder_that_is_not_there_is_named(runs, tmp_path):
    with pytest.raises(RecordingError, match="cannot write the recording"):
        record_showcase(tmp_path / "none" / "demo.rrd", runs, HISTORY, "")
