import csv

import numpy as np
import pytest
from pyarrow import parquet

from cosim import FmuPlant, simulate
from cosim.comparison import compare, load_run
from cosim.core.errors import TrajectoryError
from cosim.core.trajectory import SIGNALS, SignalKind, read_csv, read_signals
from cosim.recording import RerunRecorder, read_recording
from tests.helpers.loop import Proportional


@pytest.fixture(scope="module")
def trajectory(paper):
    with FmuPlant(paper) as plant:
        return simulate(plant, Proportional(paper), 300, seed=5)


def test_csv_reads_back_to_the_same_bits(trajectory, tmp_path):
    trajectory.write_csv(tmp_path / "t.csv")
    copy = read_csv(tmp_path / "t.csv", trajectory.scenario)
    assert list(copy.signals) == list(trajectory.signals)
    for name, signal in trajectory.signals.items():
        assert copy[name].tobytes() == signal.values.tobytes()
        assert copy.signals[name].unit == signal.unit
    assert list(copy.status) == list(trajectory.status)
    assert copy.to_csv() == trajectory.to_csv()


def test_parquet_has_the_columns_of_the_csv_for_every_reader(trajectory, tmp_path):
    trajectory.write_csv(tmp_path / "t.csv")
    trajectory.write_parquet(tmp_path / "t.parquet")
    table = parquet.read_table(tmp_path / "t.parquet")
    with (tmp_path / "t.csv").open(newline="") as stream:
        header, *rows = csv.reader(stream)
    assert table.column_names == header
    cells = [list(column) for column in zip(*rows, strict=True)]
    assert [[str(cell.as_py()) for cell in column] for column in table.columns] == cells
    signals, status = read_signals(tmp_path / "t.parquet")
    assert status == list(trajectory.status)
    for name, signal in trajectory.signals.items():
        assert signals[name].unit == signal.unit
        assert signals[name].values.tobytes() == signal.values.tobytes()
    (tmp_path / "t.parquet").write_bytes(b"PAR1 cut")
    with pytest.raises(TrajectoryError, match=r"t\.parquet' cannot be read"):
        read_signals(tmp_path / "t.parquet")


def test_clock_readings_are_only_in_the_timing(trajectory, tmp_path):
    assert set(trajectory.timing) == {"prepare", "feedback", "plant"}
    assert not {"timing", "prepare", "feedback", "plant"} & set(trajectory.summary())
    trajectory.write_timing_csv(tmp_path / "timing.csv")
    lines = (tmp_path / "timing.csv").read_text().splitlines()
    assert lines[0] == "prepare [us],feedback [us],plant [us]"
    assert len(lines) == 301


BAD = {
    "missing": (None, "cannot be read"),
    "empty": ("", "not a trajectory"),
    "other table": ("a,b\n1,2\n", "not a trajectory"),
    "short row": ("time [s],status\n0.0\n", "line 2: 1 fields, not 2"),
    "text in a number": ("time [s],status\n0.0,ok\nx,ok\n", "line 3"),
    "missing signal": ("time [s],status\n0.0,ok\n", "lacks the signal X2"),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_refused_with_its_name_and_line(case, tmp_path, paper):
    text, words = BAD[case]
    path = tmp_path / "t.csv"
    if text is not None:
        path.write_text(text)
    with pytest.raises(TrajectoryError, match=words):
        read_csv(path, paper)


def distance(scenario, columns):
    return columns["states"][:, 0] - 25.0


TOY = SignalKind("distance", distance, "%", "costs")


@pytest.fixture
def toy(monkeypatch):
    """A signal more, declared in the one place there is."""
    for module in ("core.trajectory", "core.simulation", "recording.write"):
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
    assert stored.signals["distance"].unit == "%"
    recording = read_recording(tmp_path / "run.rrd")
    np.testing.assert_array_equal(recording.signals["distance"], expected)
    assert recording.units["distance"] == "%"
    both = load_run(tmp_path), load_run(tmp_path / "run.rrd")
    assert compare(*both).equal
