from __future__ import annotations

import fmpy
import numpy as np
import pytest

import fmus
from fmus import CheckError
from fmus.checks.trajectory import experiment, reference, relative_difference, require_identical


def test_experiment_is_the_default_one() -> None:
    plan = experiment(fmpy.read_model_description(str(fmus.path())))
    assert (plan.step_size, plan.steps, plan.stop_time) == (60.0, 100, 6000.0)
    assert plan.names[:2] == ["X2", "P2"]


def test_reference_is_the_same_in_both_versions() -> None:
    assert np.array_equal(*(reference(fmus.path(name)) for name in fmus.NAMES))


def test_last_bit_counts() -> None:
    rows = reference(fmus.path())
    assert "bit-identical" in require_identical(rows, fmus.path())
    rows[50, 0] = np.nextafter(rows[50, 0], 100.0)
    with pytest.raises(CheckError, match="differs from a plain doStep loop"):
        require_identical(rows, fmus.path())


def test_relative_difference_has_a_floor_of_a_thousandth_of_the_signal() -> None:
    expected = np.array([[100.0], [0.0]])
    rows = np.array([[100.0], [0.01]])
    assert relative_difference(rows, expected) == pytest.approx(0.1)
