import hashlib
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from controllers.factories import naive
from cosim import FmuPlant, simulate
from cosim.errors import RecordingError
from cosim.recording import RerunRecorder, read_recording
from cosim.recording.run_recorder import ROWS
from cosim.recording.stream import Stream
from cosim.trajectory import read_csv
from tests.helpers.blocks import random_block
from tests.helpers.loop import Failing, Proportional

CONTROLLER = SimpleNamespace(name="mine", parameters=SimpleNamespace(hash="0123456789abcdef"))


def recorded(path, scenario, blocks, units=None, steps=100):
    recorder = RerunRecorder(path)
    recorder.start(scenario, CONTROLLER, 5, steps, units or {})
    for block in blocks:
        recorder.record(block)
    recorder.close()
    return read_recording(path)


def test_signals_equal_the_csv_bit_for_bit(tmp_path, paper):
    with FmuPlant(paper) as plant:
        recorder = RerunRecorder(tmp_path / "run.rrd")
        simulate(plant, naive(paper), 2600, 3, recorder=recorder).write_csv(tmp_path / "run.csv")
    csv = read_csv(tmp_path / "run.csv", paper)
    recording = read_recording(tmp_path / "run.rrd")
    for name, signal in csv.signals.items():
        assert recording.signals[name].tobytes() == signal.values.tobytes(), name
        assert recording.units[name] == signal.unit, name
    assert recording.status == csv.status
    assert recording.samples.tolist() == list(range(2600))
    assert np.array_equal(recording.time, csv.time)


def test_times_are_those_of_the_loop_and_predictions_those_of_the_controller(
    tmp_path, paper, rng, units
):
    blocks = [random_block(paper, rng, first, 700) for first in range(0, 4900, 700)]
    recording = recorded(tmp_path / "run.rrd", paper, blocks, units, 4900)
    for name in ("prepare_time", "feedback_time"):
        expected = np.concatenate([block[name] for block in blocks])
        assert recording.signals[name].tobytes() == expected.tobytes()
    states = np.concatenate([block.predicted_states for block in blocks])
    actions = np.concatenate([block.predicted_actions for block in blocks])
    for i, name in enumerate(paper.plant.states):
        assert np.array_equal(recording.signals[f"prediction/{name}"], states[:, :, i])
    for i, name in enumerate(paper.plant.actions):
        assert np.array_equal(recording.signals[f"prediction/{name}"], actions[:, :, i])


def test_a_block_that_the_loop_overwrites_is_recorded_as_it_was(tmp_path, paper, rng):
    block = random_block(paper, rng)
    before = block["states"].copy()
    recorder = RerunRecorder(tmp_path / "run.rrd")
    recorder.start(paper, CONTROLLER, 0, 10, {})
    recorder.record(block)
    block["states"][:] = 0.0
    recorder.close()
    recording = read_recording(tmp_path / "run.rrd")
    assert np.array_equal(recording.signals["X2"], before[:, 0])


def test_a_controller_without_predictions_is_recorded(tmp_path, paper, rng):
    recording = recorded(tmp_path / "run.rrd", paper, [random_block(paper, rng, predicts=False)])
    assert len(recording.samples) == 10
    assert not [name for name in recording.signals if name.startswith("prediction/")]


def test_samples_without_a_prediction_are_gaps(tmp_path, paper, rng):
    blocks = [random_block(paper, rng, 0, 5, predicts=False), random_block(paper, rng, 5, 5)]
    prediction = recorded(tmp_path / "run.rrd", paper, blocks).signals["prediction/X2"]
    assert np.isnan(prediction[:5]).all()
    assert np.array_equal(prediction[5:], blocks[1].predicted_states[:, :, 0])


def test_status_is_recorded_sample_by_sample(tmp_path, paper):
    with FmuPlant(paper) as plant:
        recorder = RerunRecorder(tmp_path / "run.rrd")
        trajectory = simulate(plant, Failing(paper, [3, 4, 9]), 12, 0, recorder=recorder)
    assert read_recording(tmp_path / "run.rrd").status == trajectory.status
    assert trajectory.status.count("fallback") == 3


def test_a_run_that_breaks_off_leaves_the_samples_it_made(tmp_path, paper):
    class Breaking(Proportional):
        def prepare(self):
            self.k = getattr(self, "k", -1) + 1
            if self.k == 700:
                raise RuntimeError("sensor lost")

    with FmuPlant(paper) as plant, pytest.raises(RuntimeError, match="sensor lost"):
        simulate(plant, Breaking(paper), 900, 0, recorder=RerunRecorder(tmp_path / "run.rrd"))
    assert len(read_recording(tmp_path / "run.rrd").samples) == 500


def test_properties_say_what_was_run(tmp_path, paper, rng):
    properties = recorded(tmp_path / "run.rrd", paper, [random_block(paper, rng)]).properties
    assert properties["scenario"] == "paper"
    assert properties["scenario_hash"] == paper.hash
    assert properties["seed"] == "5"
    assert properties["theta_hash"] == "0123456789abcdef"
    assert properties["controller"] == "mine"
    assert properties["package"].startswith("rti-cosim ")


def test_names_and_units_of_any_spelling_come_back(tmp_path, foreign, rng):
    block = random_block(foreign, rng)
    units = {"tank[1].level": "m³", "der(x)/dt": "∇"}
    recording = recorded(tmp_path / "run.rrd", foreign, [block], units)
    assert np.array_equal(recording.signals["tank[1].level"], block["states"][:, 0])
    assert np.array_equal(recording.signals["der(x)/dt"], block["actions"][:, 0])
    assert recording.units["tank[1].level"] == "m³"
    assert recording.units["der(x)/dt"] == "∇"


def test_the_layout_comes_before_the_data(tmp_path, paper, rng):
    recorded(tmp_path / "run.rrd", paper, [random_block(paper, rng)])
    reader = RrdReader(tmp_path / "run.rrd")
    (layout,), (recording,) = reader.blueprints(), reader.recordings()
    assert layout.application_id == recording.application_id
    content = (tmp_path / "run.rrd").read_bytes()
    assert (
        0
        < content.find(layout.recording_id.encode())
        < content.find(recording.recording_id.encode())
    )


def test_a_run_that_outgrows_the_layout_gets_another(tmp_path, paper, rng):
    first = random_block(paper, rng, 0, ROWS)
    later = {**first.columns, "time": first["time"] + first["time"][-1] + 60.0}
    within = replace(first, first=ROWS, columns=later)
    beyond = replace(within, columns=later | {"states": first["states"] * 100.0})
    for last, layouts in ((within, 1), (beyond, 2)):
        recorded(tmp_path / "run.rrd", paper, [first, last], steps=2 * ROWS)
        assert len(RrdReader(tmp_path / "run.rrd").blueprints()) == layouts


def test_a_run_without_a_sample_leaves_no_file(tmp_path, paper):
    recorder = RerunRecorder(tmp_path / "run.rrd")
    recorder.start(paper, CONTROLLER, 0, 10, {})
    recorder.close()
    assert not list(tmp_path.iterdir())


def test_the_file_is_whole_or_not_there(tmp_path, paper, rng):
    path = tmp_path / "run.rrd"
    recorder = RerunRecorder(path)
    recorder.start(paper, CONTROLLER, 0, 10, {})
    recorder.record(random_block(paper, rng))
    assert not path.exists()
    recorder.close()
    assert [entry.name for entry in tmp_path.iterdir()] == ["run.rrd"]
    assert len(RrdReader(path).store()) > 0  # only a file with a footer can be opened so
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    recorder.close()
    assert hashlib.sha256(path.read_bytes()).hexdigest() == digest


def test_an_unwritable_folder_is_named(tmp_path, paper):
    recorder = RerunRecorder(tmp_path / "none" / "run.rrd")
    with pytest.raises(RecordingError, match=r"cannot write .*none/run\.rrd"):
        recorder.start(paper, CONTROLLER, 0, 10, {})


def test_samples_are_sent_thousands_at_a_time(tmp_path, paper, monkeypatch):
    """A call to Rerun takes 30 µs, whatever it sends: by the sample it would double the step."""
    sent = []
    columns = Stream.columns
    monkeypatch.setattr(
        Stream,
        "columns",
        lambda self, entity, *rest: sent.append(entity) or columns(self, entity, *rest),
    )
    with FmuPlant(paper) as plant:
        recorder = RerunRecorder(tmp_path / "run.rrd")
        simulate(plant, Proportional(paper), 2 * ROWS, 0, recorder=recorder)
    assert len(sent) > 2
    assert max(Counter(sent).values()) == 2
