import numpy as np
import pytest

from cosim.errors import ResultsError
from cosim.reproduction.curves import increments, read_log


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
