"""The controller's FMU for every platform: what it holds, and the bits where it can be run."""

from __future__ import annotations

import importlib.util
import zipfile
from functools import cache
from pathlib import Path

import fmpy
import pytest

from controllers.factories import tuned
from cosim import FmuPlant, Scenario
from cosim.cli.controller_fmu import IDENTIFIER, rti_controller, sampled_controller, write_fmu
from fmus.information import information
from fmus.platforms import PLATFORMS
from fmus.sampled.build import sampled_sources
from tests.helpers.platforms import (
    BY_NAME,
    NATIVE,
    OTHERS,
    STEPS,
    Importer,
    NotHereError,
    library,
    unzipped,
    verdict,
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("ziglang") is None, reason="the extra 'cross' is not installed"
    ),
]


@pytest.fixture(scope="module")
def system():
    scenario = Scenario.load("paper")
    with FmuPlant(scenario) as plant:
        return sampled_controller(tuned(scenario), scenario, plant.units)


@pytest.fixture(scope="module", params=[2, 3], ids=["fmi2", "fmi3"])
def exported(request, system, tmp_path_factory) -> tuple[int, Path]:
    scenario = Scenario.load("paper")
    target = tmp_path_factory.mktemp("exported") / "controller.fmu"
    version = request.param
    return version, write_fmu(
        system, rti_controller("tuned", scenario), scenario, target, version, every_platform=True
    )


def test_it_holds_a_library_for_each_platform(exported) -> None:
    version, path = exported
    with zipfile.ZipFile(path) as container:
        held = {name for name in container.namelist() if name.startswith("binaries/")}
    expected = {library(Path(), p, version, IDENTIFIER).as_posix() for p in PLATFORMS}
    assert held == expected
    found = information(path).platforms
    assert found.pop("c-code") == ()
    assert found.keys() == {p.folder(f"{version}.0") for p in PLATFORMS}
    assert all(p.tuple in found[p.folder(f"{version}.0")] for p in PLATFORMS)
    assert fmpy.read_model_description(str(path)).fmiVersion == f"{version}.0"


@pytest.fixture(scope="module")
def run(exported, system, tmp_path_factory):
    """Lines that the host prints on a platform; skipped where it cannot be run."""
    version, path = exported
    folder = tmp_path_factory.mktemp("platforms")
    sources = sampled_sources(system, version)
    headers = {name: sources[name] for name in ("variables.h", "system.h")}
    importer = Importer("controller_host.c", headers, folder / "host")
    root = unzipped(path, folder / "fmu")

    @cache
    def runner(name: str) -> list[str]:
        try:
            file = library(root, BY_NAME[name], version, IDENTIFIER)
            return importer.run(name, file, str(version), str(STEPS))
        except NotHereError as error:
            pytest.skip(str(error))

    return runner


@pytest.mark.parametrize("name", OTHERS)
def test_ten_thousand_samples_are_bit_identical_to_the_native_ones(run, name: str) -> None:
    """States at random, so that working sets come and go and some QPs need many steps."""
    native, other = run(NATIVE), run(name)
    assert len(native) == STEPS + 1
    assert verdict(native, other) == "bit-identical"
