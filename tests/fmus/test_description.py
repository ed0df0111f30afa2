from __future__ import annotations

from importlib.resources import files
from xml.etree import ElementTree

import fmpy
import pytest
from fmpy.validation import validate_fmu
from lxml import etree

import fmus
from fmus.description import build_description, model_description
from fmus.model import Kind, Type
from fmus.variables import EVAPORATOR, VARIABLES

NAMES = {2: "evaporator", 3: "evaporator_fmi3"}


@pytest.fixture
def description(version: int):
    return fmpy.read_model_description(str(fmus.path(NAMES[version])))


def test_fmpy_finds_no_problem(version: int) -> None:
    assert validate_fmu(str(fmus.path(NAMES[version]))) == []


def test_reading_gives_no_warning(version: int, recwarn: pytest.WarningsRecorder) -> None:
    fmpy.read_model_description(str(fmus.path(NAMES[version])), validate=True)
    assert [str(w.message) for w in recwarn] == []


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


def test_every_variable_is_fully_described(description) -> None:
    for variable in description.modelVariables:
        assert variable.description
        if variable.type in ("Real", "Float64") and variable.causality != "independent":
            assert variable.unit is not None
            assert None not in (variable.min, variable.max, variable.nominal)
        if variable.initial == "exact" or variable.causality == "input":
            assert variable.start is not None


def test_there_are_no_integer_outputs(description) -> None:
    outputs = [v for v in description.modelVariables if v.causality == "output"]
    assert {v.type for v in outputs} <= {"Real", "Float64"}


def test_versions_differ_only_in_time_and_seed() -> None:
    two, three = (
        {v.name for v in fmpy.read_model_description(str(fmus.path(n))).modelVariables}
        for n in NAMES.values()
    )
    assert two ^ three == {"time", "seedHigh"}


def test_table_and_description_agree(description) -> None:
    described = {v.name: v for v in description.modelVariables}
    for row in (v for v in VARIABLES if v.type is Type.REAL and v.kind is not Kind.INDEPENDENT):
        shown = described[row.name]
        assert (float(shown.min), float(shown.max)) == (row.min, row.max)
        assert shown.unit == row.unit
        assert row.start is None or float(shown.start) == row.start


@pytest.mark.parametrize("name", ["fmi3BuildDescription", "fmi3TerminalsAndIcons"])
def test_further_xml_follows_the_standard_schema(name: str) -> None:
    schema = etree.XMLSchema(etree.parse(str(files("fmpy") / "schema" / "fmi3" / f"{name}.xsd")))
    if name == "fmi3BuildDescription":
        document = etree.fromstring(build_description(3, EVAPORATOR).encode())
    else:
        resource = files("fmus") / "resources" / "terminalsAndIcons.xml"
        document = etree.fromstring(resource.read_bytes())
    assert schema.validate(document), schema.error_log
