"""Every FMU and SSP that we make, against the standards' own XML schemas, which fmpy carries."""

import zipfile
from pathlib import Path

import fmpy
import pytest
from lxml import etree

import fmus
from cosim.cli.controller_fmu import rti_controller, sampled_controller, write_loop
from cosim.scenario import Scenario
from fmus.model import build_description, model_description
from fmus.plant import Signal, plant_model
from fmus.sampled import build_sampled

SCHEMAS = Path(fmpy.__file__).parent
FMI = {
    2: {"modelDescription.xml": "schema/fmi2/fmi2ModelDescription.xsd"},
    3: {
        "modelDescription.xml": "schema/fmi3/fmi3ModelDescription.xsd",
        "terminalsAndIcons/terminalsAndIcons.xml": "schema/fmi3/fmi3TerminalsAndIcons.xsd",
    },
}
BUILD = {"sources/buildDescription.xml": "schema/fmi3/fmi3BuildDescription.xsd"}
SSP = {
    "SystemStructure.ssd": "ssp/schema/SystemStructureDescription.xsd",
    "resources/plant.ssv": "ssp/schema/SystemStructureParameterValues.xsd",
}


def hold(text, schema):
    """Raise AssertionError with the schema's words where `text` is not valid."""
    validator = etree.XMLSchema(file=str(SCHEMAS / schema))
    assert validator.validate(etree.fromstring(text)), validator.error_log


def hold_archive(path, schemas):
    with zipfile.ZipFile(path) as container:
        present = [name for name in schemas if name in container.namelist()]
        for name in present:
            hold(container.read(name), schemas[name])
    return present


@pytest.mark.parametrize(("name", "version"), [("evaporator", 2), ("evaporator_fmi3", 3)])
def test_the_shipped_fmus(name, version):
    assert len(hold_archive(fmus.path(name), FMI[version] | BUILD)) == version


@pytest.mark.parametrize("version", [2, 3])
def test_a_plant_of_ones_own(version):
    signal = Signal("x", "m", 1.0, 0.0, 10.0, "level", 0.1)
    model = plant_model(
        "tank",
        states=[signal],
        inputs=[Signal("u", "1", 0.0, 0.0, 1.0, "valve")],
        disturbances=[Signal("d", "m", 0.0, -1.0, 1.0, "inflow", 0.1)],
        outputs=[Signal("cost", "1", 0.0, 0.0, 9.0, "cost")],
        sampling_time=1.0,
    )
    hold(model_description(version, "{1}", model).encode(), FMI[version]["modelDescription.xml"])
    hold(build_description(version, model).encode(), BUILD["sources/buildDescription.xml"])


def test_an_exported_controller_and_its_loop(tmp_path):
    scenario = Scenario.load("paper").replace({"controller": {"horizon": 2}})
    system = sampled_controller(rti_controller("naive", scenario), scenario, {"X2": "%"})
    for version in (2, 3):
        fmu = build_sampled(system, tmp_path / f"c{version}.fmu", version)
        assert len(hold_archive(fmu, FMI[version] | BUILD)) == 2
    loop = write_loop(tmp_path / "c2.fmu", scenario, 3, tmp_path / "loop.ssp")
    assert len(hold_archive(loop, SSP)) == 2
