"""What a recording holds, read back: runs, trainings, overlays; files of other kinds."""

import hashlib
from types import SimpleNamespace

import numpy as np
import pytest
import rerun as rr
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from controllers.factories import build_controller, naive
from cosim import FmuPlant, Scenario, simulate, train
from cosim.core.errors import RecordingError
from cosim.core.trajectory import RunSignals, Signal, read_csv
from cosim.recording import (
    RerunRecorder,
    read_recording,
    record_overlay,
    record_training,
    summarise,
)
from cosim.recording.read import worst_moment
from cosim.recording.stream import drawable
from tests.helpers.blocks import random_block
from tests.helpers.loop import Proportional

CONTROLLER = SimpleNamespace(name="mine", parameters=SimpleNamespace(hash="0123456789abcdef"))
numbers = st.floats(-1e6, 1e6)


def recorded(path, scenario, blocks, units=None, steps=100):
    recorder = RerunRecorder(path)
    recorder.start(scenario, CONTROLLER, 5, steps, units or {})
    for block in blocks:
        recorder.record(*block)
    recorder.close()
    return read_recording(path)


def test_signals_equal_the_csv_bit_for_bit(tmp_path, paper):
    with FmuPlant(paper) as plant:
        recorder = RerunRecorder(tmp_path / "run.rrd")
        simulate(plant, naive(paper), 1200, 3, recorder=recorder).write_csv(tmp_path / "run.csv")
    csv = read_csv(tmp_path / "run.csv", paper)
    recording = read_recording(tmp_path / "run.rrd")
    for name, signal in csv.signals.items():
        assert recording.signals[name].tobytes() == signal.values.tobytes(), name
        assert recording.units[name] == signal.unit, name
    assert recording.status == csv.status
    assert recording.samples.tolist() == list(range(1200))
    assert np.array_equal(recording.time, csv.time)


@pytest.mark.parametrize("name", ["assay", "late", "set-point", "prices", "forecast"])
def test_readings_estimates_and_signals_are_recorded_as_in_the_csv(name, tmp_path):
    """The truth, what is measured with its gaps, what is estimated, and what moves."""
    scenario = Scenario.load(name)
    with FmuPlant(scenario) as plant:
        recorder = RerunRecorder(tmp_path / "run.rrd")
        controller = build_controller("naive", scenario)
        run = simulate(plant, controller, 60, 3, recorder=recorder)
    recording = read_recording(tmp_path / "run.rrd")
    expected = ["X2", *scenario.measurement_names, *scenario.estimate_names, *scenario.signal_names]
    for signal in expected:
        assert np.array_equal(recording.signals[signal], run[signal], equal_nan=True), signal
        assert recording.units[signal] == run.signals[signal].unit
    if scenario.sensors:
        assert np.isnan(recording.signals["measured[X2]"]).any()


def test_a_block_that_the_loop_overwrites_is_recorded_as_it_was(tmp_path, paper, rng):
    block = random_block(paper, rng)
    before = {name: np.array(values) for name, values in block[1].items()}
    recorder = RerunRecorder(tmp_path / "run.rrd")
    recorder.start(paper, CONTROLLER, 0, 10, {})
    recorder.record(*block)
    for values in block[1].values():
        values[:] = 0.0
    recorder.close()
    recording = read_recording(tmp_path / "run.rrd")
    assert np.array_equal(recording.signals["X2"], before["states"][:, 0])
    assert np.array_equal(recording.signals["violation"], before["violation"])
    assert np.array_equal(recording.signals["prediction/X2"], before["predicted_states"][:, :, 0])


def test_a_run_that_breaks_off_leaves_the_samples_it_made(tmp_path, paper):
    class Breaking(Proportional):
        def prepare(self):
            self.k = getattr(self, "k", -1) + 1
            if self.k == 700:
                raise RuntimeError("sensor lost")

    with FmuPlant(paper) as plant, pytest.raises(RuntimeError):
        simulate(plant, Breaking(paper), 900, 0, recorder=RerunRecorder(tmp_path / "run.rrd"))
    assert len(read_recording(tmp_path / "run.rrd").samples) == 500


def test_names_and_units_of_any_spelling_come_back(tmp_path, foreign, rng):
    block = random_block(foreign, rng)
    units = {"tank[1].level": "m³", "der(x)/dt": "∇"}
    recording = recorded(tmp_path / "run.rrd", foreign, [block], units)
    assert np.array_equal(recording.signals["tank[1].level"], block[1]["states"][:, 0])
    assert np.array_equal(recording.signals["der(x)/dt"], block[1]["actions"][:, 0])
    assert recording.units["tank[1].level"] == "m³"
    assert recording.units["der(x)/dt"] == "∇"
    assert drawable("X2 [kg/min] θ µ °C\n∇水") == "X2 [kg/min] θ µ °C\n??"


def test_the_file_is_whole_or_not_there(tmp_path, paper, rng):
    path = tmp_path / "run.rrd"
    recorder = RerunRecorder(path)
    recorder.start(paper, CONTROLLER, 0, 10, {})
    recorder.record(*random_block(paper, rng))
    assert not path.exists()
    recorder.close()
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.rrd"]
    assert len(RrdReader(path).store()) > 0  # only a file with a footer can be opened so
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    recorder.close()
    assert hashlib.sha256(path.read_bytes()).hexdigest() == digest


def test_a_training_comes_back_as_its_log_and_the_change_of_each_block(tmp_path, paper):
    few = {"log_every": 20, "evaluate_every": 60, "evaluation_seeds": 1, "evaluation_steps": 5}
    training = train("q-learning", paper, 60, seed=9, **few)
    path = tmp_path / "t.rrd"
    record_training(path, training)
    recording = read_recording(path)
    for name, values in training.theta().items():
        one = values[:, 0] if values.shape[1] == 1 else values
        assert np.array_equal(recording.signals[f"increment/{name}"], one)
    for name, values in training.log().items():
        assert np.array_equal(recording.signals[name], values, equal_nan=True)
    assert recording.samples.tolist() == [0, 20, 40, 60]
    assert recording.properties["seed"] == "9"
    assert worst_moment(path) == 60


def run(name, **signals):
    return RunSignals(name, {key: Signal(key, "kPa", np.array(v)) for key, v in signals.items()})


def test_two_runs_are_overlaid_with_their_difference(tmp_path):
    a = run("a", time=[0.0, 60.0, 120.0], P2=[1.0, 2.0, 3.0], T=[0.0] * 3)
    b = run("b", time=[0.0, 60.0], P2=[1.0, 2.5])
    record_overlay(tmp_path / "c.rrd", {"A: a": a, "B: b": b}, "# A against B")
    signals = read_recording(tmp_path / "c.rrd").signals
    assert {name: values.tolist() for name, values in signals.items()} == {
        "A: a/P2": [1.0, 2.0, 3.0],
        "B: b/P2": [1.0, 2.5],
        "difference/P2": [0.0, -0.5],
    }


def test_the_summary_has_units_and_ranges(tmp_path, paper, rng, units):
    block = random_block(paper, rng)
    recorded(tmp_path / "run.rrd", paper, [block], units)
    summary = summarise(tmp_path / "run.rrd")
    assert summary["samples"] == 10
    assert summary["statuses"] == {"solved": 10}
    assert summary["signals"]["X2"] == {
        "unit": "%",
        "minimum": block[1]["states"][:, 0].min(),
        "maximum": block[1]["states"][:, 0].max(),
    }
    assert summary["signals"]["residual"]["minimum"] is None


def _text(path):
    path.write_text("not a recording " * 100)


def _foreign(path):
    stream = rr.RecordingStream("other")
    stream.save(path)
    stream.log("a", rr.Scalars(1.0))
    stream.disconnect()


@pytest.mark.parametrize("make", [lambda path: None, _text, _foreign])
def test_what_is_no_recording_of_ours_is_refused(tmp_path, make):
    make(tmp_path / "x.rrd")
    with pytest.raises(RecordingError, match=r"x\.rrd"):
        read_recording(tmp_path / "x.rrd")
    assert worst_moment(tmp_path / "x.rrd") is None


def test_states_within_the_samples_of_an_fmi3_plant_are_recorded(paper, tmp_path):
    recorder = RerunRecorder(tmp_path / "run.rrd")
    with FmuPlant(paper, "evaporator_fmi3", recorder.intermediate) as plant:
        run = simulate(plant, naive(paper), 30, 1, recorder=recorder)
    time, X2 = read_recording(tmp_path / "run.rrd").intermediate["X2"].T
    assert time.tolist() == list(range(1, 1801))
    assert X2[59::60].tolist() == [*run["X2"][1:], run.final_state[0]]
