"""Every FMU and SSP that we make, against the standards' own XML schemas, in `tests/schemas`."""

import zipfile
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import fmpy
import numpy as np
import pytest
from fmpy.validation import validate_fmu
from lxml import etree

import fmus
from cosim.cli.controller_fmu import rti_controller, sampled_controller, write_loop
from cosim.core.scenario import Scenario
from fmus import plant as plants
from fmus.build import build_model
from fmus.evaporator import EVAPORATOR, UNITS, VARIABLES
from fmus.model import (
    Kind,
    Type,
    build_description,
    continuous_dependencies,
    initial_dependencies,
    model_description,
    terminals,
    unit,
)
from fmus.plant import Signal, plant_model

NAMES = {2: "evaporator", 3: "evaporator_fmi3"}


@pytest.fixture
def description(version: int):
    return fmpy.read_model_description(str(fmus.path(NAMES[version])))


def test_every_initial_unknown_has_explicit_dependencies(description) -> None:
    for unknown in (*description.initialUnknowns, *description.outputs, *description.derivatives):
        assert unknown.dependencies is not None
        assert len(unknown.dependencies) == len(unknown.dependenciesKind)


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


BY_NAME = EVAPORATOR.by_name


@pytest.mark.parametrize("variable", VARIABLES, ids=lambda v: v.name)
def test_ranges_are_given_and_hold_the_start(variable) -> None:
    if variable.kind is Kind.INDEPENDENT or variable.type in (Type.SEED, Type.SEED_HIGH):
        return
    assert variable.min < variable.max
    if variable.settable:
        assert variable.min <= variable.start <= variable.max
    if variable.type is Type.REAL:
        assert variable.nominal is not None
        assert variable.unit in UNITS


def test_extreme_normal_draws_stay_within_the_declared_range() -> None:
    """The largest |Z| of 53-bit Box and Muller is √(106 ln 2) = 8.58."""
    largest = np.sqrt(106 * np.log(2))
    for name in ("X1", "F1", "T1", "T200"):
        nominal, spread = BY_NAME[f"{name}_nominal"], BY_NAME[f"{name}_range"]
        assert BY_NAME[name].min <= nominal.min - largest * spread.max
        assert BY_NAME[name].max >= nominal.max + largest * spread.max


SI = {
    "kW.min/(kg.K)": (60_000, 0, {"m": 2, "s": -2, "K": -1}),
    "degC": (1, 273.15, {"K": 1}),
    "degC/s": (1, 0, {"K": 1, "s": -1}),
    "degF": (5 / 9, 273.15 - 32 * 5 / 9, {"K": 1}),
    "bar": (1e5, 0, {"kg": 1, "m": -1, "s": -2}),
    "cm3/(V.s)": (1e-6, 0, {"kg": -1, "m": 1, "s": 2, "A": 1}),
    "mol/L/s": (1000, 0, {"mol": 1, "m": -3, "s": -1}),
    "%": (0.01, 0, {}),
    "rpm": (2 * np.pi / 60, 0, {"s": -1, "rad": 1}),
}


@pytest.mark.parametrize("name", SI)
def test_the_si_form_of_units(name):
    factor, offset, exponents = SI[name]
    found = unit(name)
    assert (found.factor, found.offset) == pytest.approx((factor, offset), rel=1e-15)
    assert dict(found.exponents) == exponents


@pytest.mark.parametrize("version", [2, 3])
def test_a_unit_without_si_form_is_no_plain_number(version):
    """BaseUnit without attributes says that the unit is 1."""
    names = ("furlong", "kW/kg.K", "bar")
    model = replace(EVAPORATOR, units=names)
    root = ElementTree.fromstring(model_description(version, "", model))
    forms = {u.get("name"): u.find("BaseUnit") for u in root.iter("Unit")}
    assert [name for name in names if forms[name] is None] == ["furlong", "kW/kg.K"]
    assert forms["bar"].attrib == {"kg": "1", "m": "-1", "s": "-2", "factor": "100000.0"}


def members(model) -> dict[str, str]:
    """The causality of what the terminal connects, by the name that is matched."""
    (text,) = terminals(model).values()
    variables = ElementTree.fromstring(model_description(3, "", model)).find("ModelVariables")
    causality = {each.get("name"): each.get("causality") for each in variables}
    found = ElementTree.fromstring(text).iter("TerminalMemberVariable")
    return {each.get("memberName"): causality[each.get("variableName")] for each in found}


@pytest.mark.parametrize("name", ["paper", "reactor", "tanks", "dead-time"])
def test_the_terminals_of_plant_and_controller_fit_each_other(name):
    fmu = Scenario.load(name).plant.fmu
    plant = members(EVAPORATOR if name == "paper" else plants.model(fmu))
    scenario = Scenario.load(name).replace({"controller": {"horizon": 2}})
    controller = members(sampled_controller(rti_controller("naive", scenario), scenario))
    assert plant.keys() == controller.keys()
    assert all({plant[each], controller[each]} == {"input", "output"} for each in plant)
    assert [name for name in plant if plant[name] == "output"] == list(scenario.plant.states)


SCHEMAS = Path(__file__).parents[1] / "schemas"
FMI = {
    2: {"modelDescription.xml": "fmi2/fmi2ModelDescription.xsd"},
    3: {
        "modelDescription.xml": "fmi3/fmi3ModelDescription.xsd",
        "terminalsAndIcons/terminalsAndIcons.xml": "fmi3/fmi3TerminalsAndIcons.xsd",
    },
}
BUILD = {"sources/buildDescription.xml": "fmi3/fmi3BuildDescription.xsd"}
SSP = {
    version: {
        "SystemStructure.ssd": f"ssp{version}/SystemStructureDescription.xsd",
        "resources/plant.ssv": f"ssp{version}/SystemStructureParameterValues.xsd",
    }
    for version in (1, 2)
}


def hold(text, schema):
    """Raise DocumentInvalid with the schema's words where `text` is not valid."""
    etree.XMLSchema(file=str(SCHEMAS / schema)).assertValid(etree.fromstring(text))


def hold_archive(path, schemas):
    with zipfile.ZipFile(path) as container:
        for name in (present := [name for name in schemas if name in container.namelist()]):
            hold(container.read(name), schemas[name])
    return present


@pytest.mark.parametrize(("name", "version"), [("evaporator", 2), ("evaporator_fmi3", 3)])
def test_the_shipped_fmus(name, version):
    assert len(hold_archive(fmus.path(name), FMI[version] | BUILD)) == version


@pytest.mark.parametrize("version", [2, 3])
def test_a_plant_of_ones_own(version):
    signal = Signal("x", "furlong", 1.0, 0.0, 10.0, "level", 0.1)
    model = plant_model(
        "tank",
        states=[signal],
        inputs=[Signal("u", "1", 0.0, 0.0, 1.0, "valve")],
        disturbances=[Signal("d", "m", 0.0, -1.0, 1.0, "inflow", 0.1)],
        outputs=[Signal("cost", "1", 0.0, 0.0, 9.0, "cost")],
        sampling_time=1.0,
    )
    hold(model_description(version, "{1}", model).encode(), FMI[version]["modelDescription.xml"])
    built = build_description(version, model).encode()
    hold(built, BUILD["sources/buildDescription.xml"])
    options = etree.fromstring(built).find(".//SourceFileSet").attrib
    assert {"compiler", "compilerOptions"} <= {*options}


@pytest.mark.slow
@pytest.mark.usefixtures("quickly_built")
def test_an_exported_controller_and_its_loop(tmp_path):
    scenario = Scenario.load("paper").replace({"controller": {"horizon": 2}})
    controller = rti_controller("naive", scenario, ("X1",))
    system = sampled_controller(controller, scenario, ("X1",))
    for version in (2, 3):
        fmu = build_model(system, tmp_path / f"c{version}.fmu", version)
        assert len(hold_archive(fmu, FMI[version] | BUILD)) == version
        assert validate_fmu(str(fmu)) == []
    for version, plant in ((2, "evaporator"), (2, "evaporator_fmi3"), (3, "evaporator")):
        either = scenario.replace({"plant": {"fmu": plant}})
        loop = write_loop(tmp_path / f"c{version}.fmu", either, 3, tmp_path / "loop.ssp", ("X1",))
        assert len(hold_archive(loop, SSP[1 if (version, plant) == (2, "evaporator") else 2])) == 2
