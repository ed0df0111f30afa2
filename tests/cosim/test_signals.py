import numpy as np
import pytest

from cosim import FmuPlant, simulate
from cosim.comparison import compare, load_run
from cosim.recording import RerunRecorder, read_recording
from cosim.trajectory import SIGNALS, SignalKind, read_csv
from tests.helpers.loop import Proportional


def distance(scenario, columns):
    return columns["states"][:, 0] - 25.0


TOY = SignalKind("distance", distance, "%", "costs")


@pytest.fixture
def toy(monkeypatch):
    """A signal more, declared in the one place there is."""
    for module in ("trajectory", "simulation", "recording.run"):
        monkeypatch.setattr(f"cosim.{module}.SIGNALS", (*SIGNALS, TOY))


def run(folder, scenario):
    recorder = RerunRecorder(folder / "run.rrd")
    with FmuPlant(scenario) as plant:
        trajectory = simulate(plant, Proportional(scenario), 30, 1, recorder=recorder)
    trajectory.write_csv(folder / "trajectory.csv")
    return trajectory


def test_a_signal_declared_in_one_place_is_simulated_stored_recorded_and_read(toy, tmp_path, paper):
    trajectory = run(tmp_path, paper)
    expected = trajectory.states[:, 0] - 25.0
    np.testing.assert_array_equal(trajectory["distance"], expected)
    stored = read_csv(tmp_path / "trajectory.csv", paper)
    np.testing.assert_array_equal(stored["distance"], expected)
    assert stored.signals["distance"].header == "distance [%]"
    recording = read_recording(tmp_path / "run.rrd")
    np.testing.assert_array_equal(recording.signals["distance"], expected)
    assert recording.units["distance"] == "%"
    both = load_run(tmp_path), load_run(tmp_path / "run.rrd")
    assert compare(*both).equal
