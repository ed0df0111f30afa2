"""Runge-Kutta steps that are too few: refused, or named with a number that suffices."""

import dataclasses
import warnings

import casadi as ca
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

from controllers import Parameters, Problem, QpError, RtiNmpc
from controllers.errors import ModelError, ModelWarning
from controllers.model import INTEGRATION_TOLERANCE
from controllers.preparation import integration_of
from cosim.core.scenario import Scenario
from tests.helpers.models import make_model, make_problem

PRESETS = ("paper", "fast-sampling", "slow-sampling", "reactor", "tanks")


@pytest.mark.parametrize("preset", PRESETS)
def test_the_presets_are_integrated_finely(preset):
    assert not integration_of(Problem.from_scenario(Scenario.load(preset))).coarse


def fast_and_slow(rate, substeps=2):
    """A slow state, and a fast one that goes to the action at a rate times the sampling time."""
    model = make_model(
        lambda x, u, d, p: ca.vertcat(-0.3 * x[0] + x[1], rate * (u - x[1] + 0.1 * x[0] ** 2))
    )
    return make_problem(model, sampling_time=1.0, substeps=substeps, horizon=1)


@settings(max_examples=5)
@given(st.floats(-1.0, 1.5))
def test_a_fast_state_is_refused_named_or_accurate(power):
    judge_fast_state(10.0**power)


@pytest.mark.slow
@settings(max_examples=30)
@given(st.floats(-1.0, 2.8))
def test_a_very_fast_state_is_refused_named_or_accurate(power):
    judge_fast_state(10.0**power)


def judge_fast_state(rate):
    """The fast state alone is linear: its exact decay over a sample is e^−λ."""
    problem = fast_and_slow(rate)
    z = -rate / 2
    growth = 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24
    build = lambda: RtiNmpc(problem, Parameters.naive(problem))  # noqa: E731
    if abs(growth) > 1.001:
        with pytest.raises(ModelError, match=f"substeps = {integration_of(problem).suffices}"):
            build()
    elif abs(growth**2 - np.exp(-rate)) > 3 * INTEGRATION_TOLERANCE:
        with warnings.catch_warnings(record=True) as shown:
            warnings.simplefilter("always")
            build()
        assert [one.category for one in shown] == [ModelWarning]
        assert f"substeps = {integration_of(problem).suffices}" in str(shown[0].message)
    mended = dataclasses.replace(problem, substeps=integration_of(problem).suffices)
    assert not integration_of(mended).coarse
    A = np.array([[-0.3, 1.0], [0.0, -rate]])
    exact = expm(A)
    controller = RtiNmpc(mended, Parameters.naive(mended))
    controller.prepare()
    found = controller.feedback([0.0, 0.0]).prepared.part("A").reshape(-1, 2, 2)[0]
    np.testing.assert_allclose(found, exact, atol=INTEGRATION_TOLERANCE)


def test_an_unstable_plant_is_not_called_stiff():
    model = make_model(lambda x, u, d, p: ca.vertcat(2.0 * x[0] + u, -x[1] + x[0]))
    integration = integration_of(make_problem(model))
    assert not integration.unstable and not integration.coarse


def test_a_plant_whose_solution_ends_at_a_corner_is_judged_elsewhere():
    model = make_model(lambda x, u, d, p: ca.vertcat(x[0] ** 3 - x[0] + u, -x[1]))
    problem = make_problem(model, width=50.0)
    assert integration_of(problem).suffices is not None


def test_a_qp_that_fails_away_from_the_reference_names_the_substeps():
    model = make_model(
        lambda x, u, d, p: ca.vertcat(-0.3 * x[0] + x[1], (1 + 4 * x[0] ** 2) * (u - x[1]))
    )
    problem = make_problem(model, sampling_time=1.0, width=5.0)
    with pytest.warns(ModelWarning, match="at the bounds"):
        controller = RtiNmpc(problem, Parameters.naive(problem))
    with pytest.raises(QpError, match=f"substeps = {integration_of(problem).suffices}"):
        for _ in range(5):
            controller.prepare()
            controller.feedback([5.0, 5.0])
