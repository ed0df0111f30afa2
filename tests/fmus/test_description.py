from __future__ import annotations

from xml.etree import ElementTree

import fmpy
import pytest

import fmus
from fmus.evaporator import EVAPORATOR, VARIABLES
from fmus.model import Kind, Type, continuous_dependencies, initial_dependencies, model_description

NAMES = {2: "evaporator", 3: "evaporator_fmi3"}


@pytest.fixture
def description(version: int):
    return fmpy.read_model_description(str(fmus.path(NAMES[version])))


def test_capabilities(description, version: int) -> None:
    for interface in (description.coSimulation, description.modelExchange):
        assert interface.canGetAndSetFMUstate
        assert interface.canSerializeFMUstate
        assert interface.providesAdjointDerivatives == (version == 3)
        assert not interface.canBeInstantiatedOnlyOncePerProcess
    assert description.coSimulation.canHandleVariableCommunicationStepSize
    assert not description.coSimulation.fixedInternalStepSize
    name = "providesDirectionalDerivative" + ("s" if version == 3 else "")
    root = ElementTree.fromstring(model_description(version, "", EVAPORATOR))
    assert [root.find(t).get(name) for t in ("CoSimulation", "ModelExchange")] == ["true", "true"]


def test_versions_differ_only_in_time_and_seed() -> None:
    two, three = (
        {v.name for v in fmpy.read_model_description(str(fmus.path(n))).modelVariables}
        for n in NAMES.values()
    )
    assert two ^ three == {"time", "seedHigh", "law_number"}


def test_table_and_description_agree(description) -> None:
    described = {v.name: v for v in description.modelVariables}
    for row in (v for v in VARIABLES if v.type is Type.REAL and v.kind is not Kind.INDEPENDENT):
        shown = described[row.name]
        assert (float(shown.min), float(shown.max)) == (row.min, row.max)
        assert shown.unit == row.unit
        assert row.start is None or float(shown.start) == row.start


def test_every_initial_unknown_has_explicit_dependencies(description) -> None:
    for unknown in (*description.initialUnknowns, *description.outputs, *description.derivatives):
        assert unknown.dependencies is not None
        assert len(unknown.dependencies) == len(unknown.dependenciesKind)


def test_dependencies_of_the_file_are_those_of_the_table(description, version: int) -> None:
    shown = {v.name for v in EVAPORATOR.exported(version)}
    for unknown in description.initialUnknowns:
        names = [v.name for v in unknown.dependencies]
        expected = initial_dependencies(unknown.variable.name, EVAPORATOR)
        assert names == [n for n in expected if n in shown]


UNKNOWNS = [v.name for v in VARIABLES if v.kind in (Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT)]
MODES = [{}, {"law": 2}, {"stochastic": False}, {"override": True}, {"fouling_rate": 0.3}]


def moved(name: str) -> float:
    variable = EVAPORATOR.by_name[name]
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
    start = mode.get(name, EVAPORATOR.by_name[name].start)
    is_real = EVAPORATOR.by_name[name].type is Type.REAL
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
