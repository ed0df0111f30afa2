from dataclasses import dataclass
from math import nan
from types import SimpleNamespace

import numpy as np
import pytest

from cosim.errors import RecordingError
from cosim.recording import TrainingRecorder, read_recording
from tests.helpers.loop import Answer, Proportional, SolverFailed

LABELS = ("b[0]", "b[1]", "c", "B[0,0]", "B[0,1]", "B[1,1]")
BLOCKS = SimpleNamespace(
    slices={"b": slice(0, 2), "c": slice(2, 3), "B": slice(3, 6)}, labels=LABELS
)


@dataclass
class Theta:
    theta: np.ndarray
    blocks = BLOCKS
    hash = "fedcba9876543210"


def training_run(scenario):
    configuration = SimpleNamespace(model_dump=lambda mode: {"gain": 0.3})
    return SimpleNamespace(
        algorithm="q-learning", scenario=scenario, samples=100, seed=9, configuration=configuration
    )


def row(samples, td_error=1.0, greedy=nan):
    return {
        "samples": samples,
        "td_error": td_error,
        "updates": 1,
        "greedy_J": greedy,
    }


def recorded(path, scenario, rows, thetas, controller=None):
    recorder = TrainingRecorder(path)
    recorder.start(training_run(scenario), Theta(np.zeros(6)))
    for entry, theta in zip(rows, thetas, strict=True):
        recorder.record(entry, Theta(theta), controller or Proportional(scenario))
    recorder.close()
    return read_recording(path)


def test_parameters_come_back_by_block(tmp_path, paper, rng):
    thetas = rng.normal(size=(150, 6))
    recording = recorded(tmp_path / "t.rrd", paper, [row(k) for k in range(150)], thetas)
    assert np.array_equal(recording.signals["theta/b"], thetas[:, :2])
    assert np.array_equal(recording.signals["theta/c"], thetas[:, 2])
    assert np.array_equal(recording.signals["theta/B"], thetas[:, 3:])
    assert recording.samples.tolist() == list(range(150))


def test_the_log_comes_back_column_by_column(tmp_path, paper, rng):
    errors = rng.random(70)
    rows = [row(1000 * k, error) for k, error in enumerate(errors)]
    signals = recorded(tmp_path / "t.rrd", paper, rows, np.zeros((70, 6))).signals
    assert np.array_equal(signals["td_error"], errors)
    assert np.isnan(signals["greedy_J"]).all()


def test_the_td_error_is_averaged_over_the_preceding_ten_thousand_samples(tmp_path, paper, rng):
    errors = rng.random(40)
    errors[7] = nan
    rows = [row(1000 * (k + 1), error) for k, error in enumerate(errors)]
    mean = recorded(tmp_path / "t.rrd", paper, rows, np.zeros((40, 6))).signals["td_error_mean"]
    for k in range(40):
        window = errors[max(0, k - 9) : k + 1]
        assert mean[k] == pytest.approx(np.sqrt(np.nanmean(window**2)), rel=1e-12)


def test_the_policy_is_recorded_where_it_was_evaluated(tmp_path, paper):
    rows = [row(1), row(2, greedy=7.0), row(3)]
    controller = Proportional(paper, gain=2.0)
    recording = recorded(tmp_path / "t.rrd", paper, rows, np.zeros((3, 6)), controller)
    steam = recording.signals["policy/P100"]
    assert steam.shape == (1, 225)
    grid = np.linspace(25.0 - 0.06 * 75.0, 25.0 + 0.06 * 75.0, 15)
    expected = paper.reference_action[0] + 2.0 * (25.0 - grid)
    assert np.allclose(steam.reshape(15, 15), expected, rtol=1e-14)
    assert np.allclose(recording.signals["policy/value"].reshape(15, 15), 25.0 - grid, atol=1e-12)


def test_states_where_the_controller_fails_are_gaps_in_the_map(tmp_path, paper):
    class Picky(Proportional):
        def feedback(self, s, a=None):
            if s[1] > 50.0:
                raise SolverFailed("no solution")
            return Answer(self._scenario.reference_action, value=1.0)

    signals = recorded(
        tmp_path / "t.rrd", paper, [row(1, greedy=7.0)], np.zeros((1, 6)), Picky(paper)
    ).signals
    failed = np.isnan(signals["policy/value"].reshape(15, 15))
    assert failed.any(axis=1).tolist() == failed.all(axis=1).tolist()
    assert 0 < failed.all(axis=1).sum() < 15


def test_the_map_leaves_the_controller_reset(tmp_path, paper):
    controller = Proportional(paper)
    recorded(tmp_path / "t.rrd", paper, [row(1, greedy=7.0)], np.zeros((1, 6)), controller)
    assert controller.resets == 15 * 15 + 1


def test_a_plant_with_one_state_has_no_map(tmp_path, foreign):
    recording = recorded(tmp_path / "t.rrd", foreign, [row(1, greedy=7.0)], np.zeros((1, 6)))
    assert not [name for name in recording.signals if name.startswith("policy/")]


def test_properties_hold_run_and_configuration(tmp_path, paper):
    properties = recorded(tmp_path / "t.rrd", paper, [row(1)], np.zeros((1, 6))).properties
    assert properties["algorithm"] == "q-learning"
    assert properties["gain"] == "0.3"
    assert properties["theta_hash"] == "fedcba9876543210"


def test_an_unwritable_folder_is_named(tmp_path, paper):
    with pytest.raises(RecordingError, match="cannot write"):
        TrainingRecorder(tmp_path / "no" / "t.rrd").start(training_run(paper), Theta(np.zeros(6)))
