"""Directional derivatives of the FMU against differences of its own outputs."""

import numpy as np
import pytest

from fmus.evaporator import EVAPORATOR, VARIABLES
from fmus.model import Kind, Type

REALS = [v for v in VARIABLES if v.type is Type.REAL]
UNKNOWNS = [v.name for v in REALS if v.kind in (Kind.OUTPUT, Kind.DERIVATIVE, Kind.STATE)]
KNOWNS = [v.name for v in REALS if v.kind in (Kind.INPUT, Kind.TUNABLE)]
SWITCHES = [{}, {"law": 2}, {"stochastic": False}, {"override": True}, {"fouling_rate": 2.0}]


def jacobian(instance, unknowns: list[str], knowns: list[str]) -> np.ndarray:
    columns = [instance.directional(unknowns, [known], [1.0]) for known in knowns]
    return np.array(columns).T


CENTRAL = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60, -1: -3 / 4, -2: 3 / 20, -3: -1 / 60}
FORWARD = {0: -49 / 20, 1: 6.0, 2: -15 / 2, 3: 20 / 3, 4: -15 / 4, 5: 6 / 5, 6: -1 / 6}


def differences(instance, unknowns: list[str], known: str) -> np.ndarray:
    """Differences of the sixth order, whose truncation error is below rounding.

    Central ones, but forward ones where the value is the least that the variable may have.
    """
    centre = instance.get(known)[0]
    at_least = centre == EVAPORATOR.by_name[known].min
    h = 1e-2 if at_least else 1e-3 * max(1e-2, abs(centre))
    total = np.zeros(len(unknowns))
    for offset, weight in (FORWARD if at_least else CENTRAL).items():
        instance.set(**{known: centre + offset * h})
        total += weight * np.array(instance.get(*unknowns))
    instance.set(**{known: centre})
    return total / h


@pytest.mark.parametrize("switches", SWITCHES, ids=str)
def test_inputs_and_parameters(plant, switches: dict[str, float]) -> None:
    plant.initialise(seed=2, X2_start=31.0, P2_start=55.0, P100=250.0, F200=160.0, **switches)
    plant.step(0.0, 60.0)
    exact = jacobian(plant, UNKNOWNS, KNOWNS)
    for known, column in zip(KNOWNS, exact.T, strict=True):
        numeric = differences(plant, UNKNOWNS, known)
        np.testing.assert_allclose(column, numeric, rtol=1e-7, atol=1e-7, err_msg=known)


def test_states(model) -> None:
    model.initialise(X2_start=31.0, P2_start=55.0, P100=250.0)
    model.start_continuous_time()
    exact = jacobian(model, UNKNOWNS, ["X2", "P2"])
    for i, column in enumerate(exact.T):
        numeric = np.zeros(len(UNKNOWNS))
        for sign in (1, -1):
            x = [31.0, 55.0]
            x[i] += sign * 1e-3
            model.set_states(x)
            numeric += sign * np.array(model.get(*UNKNOWNS)) / 2e-3
        np.testing.assert_allclose(column, numeric, rtol=1e-7, atol=1e-7)


def test_start_parameters_in_initialisation_mode(plant) -> None:
    plant.enter_initialisation()
    exact = jacobian(plant, UNKNOWNS, ["X2_start", "P2_start"])
    for known, column in zip(["X2_start", "P2_start"], exact.T, strict=True):
        numeric = differences(plant, UNKNOWNS, known)
        np.testing.assert_allclose(column, numeric, rtol=1e-7, atol=1e-7)


def test_seed_of_several_knowns_is_the_sum_of_columns(plant) -> None:
    plant.initialise(seed=2, override=True)
    seed = np.linspace(-1.0, 2.0, len(KNOWNS))
    together = plant.directional(UNKNOWNS, KNOWNS, list(seed))
    np.testing.assert_allclose(
        together, jacobian(plant, UNKNOWNS, KNOWNS) @ seed, rtol=1e-12, atol=1e-9
    )
