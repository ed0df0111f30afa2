"""Adjoint derivatives (FMI 3.0) are the transpose of the directional ones."""

from __future__ import annotations

import numpy as np
import pytest

from fmus.evaporator import EVAPORATOR, VARIABLES
from fmus.model import Kind, Type

REALS = [v for v in VARIABLES if v.type is Type.REAL]
UNKNOWNS = [v.name for v in REALS if v.kind in (Kind.OUTPUT, Kind.DERIVATIVE, Kind.STATE)]
KNOWNS = [v.name for v in REALS if v.kind in (Kind.INPUT, Kind.TUNABLE, Kind.FIXED, Kind.STATE)]


def references(names: list[str]) -> list[int]:
    return [EVAPORATOR.value_reference(name) for name in names]


def adjoint(instance, seed: np.ndarray) -> np.ndarray:
    values = instance.fmu.getAdjointDerivative(
        references(UNKNOWNS), references(KNOWNS), list(seed), nSensitivity=len(KNOWNS)
    )
    return np.array(list(values))


@pytest.mark.parametrize(
    "switches",
    [{}, {"law": 2}, {"stochastic": False}, {"override": True}, {"fouling_rate": 2.0}],
    ids=str,
)
@pytest.mark.parametrize("initialising", [True, False])
def test_adjoint_is_the_transposed_jacobian(open_fmu, switches, initialising: bool) -> None:
    instance = open_fmu(3)
    instance.set(seed=2, X2_start=31.0, P100=250.0, **switches)
    instance.enter_initialisation()
    if not initialising:
        instance.fmu.exitInitializationMode()
    columns = [instance.directional(UNKNOWNS, [known], [1.0]) for known in KNOWNS]
    jacobian = np.array(columns).T
    for row, unit in zip(jacobian, np.eye(len(UNKNOWNS)), strict=True):
        np.testing.assert_allclose(adjoint(instance, unit), row, rtol=1e-12, atol=1e-12)
