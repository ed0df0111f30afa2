"""Declared dependencies are exactly those that the FMU shows when a variable is moved."""

from __future__ import annotations

from fmus.dependencies import continuous_dependencies, initial_dependencies
from fmus.model import Kind, Type
from fmus.variables import BY_NAME, EVAPORATOR, VARIABLES

UNKNOWNS = [v.name for v in VARIABLES if v.kind in (Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT)]
MODES = [{}, {"law": 2}, {"stochastic": False}, {"override": True}, {"fouling_rate": 0.3}]


def moved(name: str) -> float:
    variable = BY_NAME[name]
    if variable.type is Type.BOOLEAN:
        return not variable.start
    if variable.type is Type.LAW:
        return 2
    if variable.type is Type.REAL:
        return variable.start + 0.1 * (variable.max - variable.start)
    return 1


def affected(instance, name: str, mode: dict[str, float]) -> set[str]:
    before = instance.get(*UNKNOWNS)
    instance.set(**{name: moved(name)})
    after = instance.get(*UNKNOWNS)
    start = mode.get(name, BY_NAME[name].start)
    is_real = BY_NAME[name].type is Type.REAL
    instance.set(**{name: start if is_real else int(start)})
    assert instance.get(*UNKNOWNS) == before
    return {u for u, x, y in zip(UNKNOWNS, before, after, strict=True) if x != y}


def test_initial_dependencies(open_fmu) -> None:
    # far from the steady state, and after a cleaning, where every grid and period matters
    base = {"X2_start": 30.0, "P2_start": 60.0, "X1_in": 6.0, "F1_in": 9.0, "T1_in": 50.0}
    found: dict[str, set[str]] = {name: set() for name in UNKNOWNS}
    settable = [v.name for v in VARIABLES if v.settable]
    for mode in MODES:
        instance = open_fmu(2)
        instance.set(**base, **mode)
        instance.enter_initialisation(start=6.5 * 86400.0)
        for name in settable:
            for unknown in affected(instance, name, base | mode):
                found[unknown].add(name)
    assert found == {name: set(initial_dependencies(name, EVAPORATOR)) for name in UNKNOWNS}


def test_continuous_dependencies(open_fmu) -> None:
    found: dict[str, set[str]] = {name: set() for name in UNKNOWNS}
    inputs = [v.name for v in VARIABLES if v.kind is Kind.INPUT]
    for mode in MODES:
        model = open_fmu(2, exchange=True).initialise(X2_start=30.0, P2_start=60.0, **mode)
        model.start_continuous_time()
        for name in inputs:
            for unknown in affected(model, name, {}):
                found[unknown].add(name)
        before = model.get(*UNKNOWNS)
        for i, name in enumerate(("X2", "P2")):
            x = [30.0, 60.0]
            x[i] += 1.0
            model.set_states(x)
            after = model.get(*UNKNOWNS)
            for unknown, old, new in zip(UNKNOWNS, before, after, strict=True):
                if old != new:
                    found[unknown].add(name)
        model.set_states([30.0, 60.0])
    assert found == {name: set(continuous_dependencies(name, EVAPORATOR)) for name in UNKNOWNS}
