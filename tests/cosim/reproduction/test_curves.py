import numpy as np
import pytest

from cosim.errors import ResultsError
from cosim.reproduction.curves import increments, read_log, running_mean


def test_the_running_mean_is_that_of_the_updates_within_the_window():
    rng = np.random.default_rng(0)
    samples = np.arange(1, 41) * 500.0
    weights = rng.integers(0, 6, 40).astype(float)
    values = np.where(weights > 0, rng.normal(size=40), np.nan)
    found = running_mean(samples, values, weights, 10_000)
    for k in range(40):
        inside = (samples > samples[k] - 10_000) & (samples <= samples[k])
        if samples[k] < 10_000:
            assert np.isnan(found[k])
            continue
        updates = np.repeat(values[inside], weights[inside].astype(int))
        assert found[k] == pytest.approx(updates.mean(), rel=1e-12)


def test_increments_are_taken_from_the_start_and_grouped_by_block():
    log = {
        "samples": np.array([1.0, 2.0]),
        "theta B_l[0,0]": np.array([1.0, 3.0]),
        "theta B_l[0,1]": np.array([0.0, -1.0]),
        "theta c_lambda": np.array([6210.0, 6211.0]),
    }
    found = increments(log, {"B_l[0,0]": 1.0, "B_l[0,1]": 0.0, "c_lambda": 6210.0})
    np.testing.assert_array_equal(found["B_l"], [[0.0, 0.0], [2.0, -1.0]])
    np.testing.assert_array_equal(found["c_lambda"], [[0.0], [1.0]])


def test_a_log_reads_empty_cells_as_undefined(tmp_path):
    (tmp_path / "learning.csv").write_text("samples,greedy_J\n500,\n1000,6400.5\n")
    log = read_log(tmp_path / "learning.csv")
    np.testing.assert_array_equal(log["greedy_J"], [np.nan, 6400.5])


def test_an_empty_log_is_refused(tmp_path):
    (tmp_path / "learning.csv").write_text("samples,greedy_J\n")
    with pytest.raises(ResultsError, match=r"learning\.csv' is empty"):
        read_log(tmp_path / "learning.csv")
