"""Binaries of plant and controller: each platform's gives the bits of the native one.

Cross-compilers and emulators take minutes: `make platforms`, which CI runs too.
"""

import zipfile
from functools import cache
from pathlib import Path

import fmpy
import pytest

from fmus import PLATFORMS
from fmus.check import information
from tests.helpers.platforms import (
    CROSS,
    LAWS,
    NATIVE,
    OTHERS,
    STEPS,
    VERSIONS,
    Hosted,
    hosted_controller,
    hosted_plant,
    library,
    verdict,
)

pytestmark = [pytest.mark.platforms, CROSS]


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory):
    """Lines that the host prints on a platform; skipped where it cannot be run."""
    folder = tmp_path_factory.mktemp("platforms")
    plants = {version: hosted_plant(version, folder) for version in VERSIONS}

    @cache
    def runner(name: str, version: int, law: str) -> list[str]:
        return plants[version].run_or_skip(name, law)

    return runner


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", OTHERS)
def test_ten_thousand_steps_are_bit_identical_to_the_native_ones(run, name, version, law) -> None:
    native, other = run(NATIVE, version, law), run(name, version, law)
    assert len(native) == STEPS + 1
    assert verdict(native, other) == "bit-identical"


@pytest.mark.parametrize("law", LAWS)
def test_both_fmi_versions_give_the_same_bits(run, law: str) -> None:
    assert run(NATIVE, 2, law) == run(NATIVE, 3, law)


def test_laws_differ(run) -> None:
    """The hashes see what they are to compare."""
    assert len({run(NATIVE, 2, law)[0] for law in LAWS[:3]}) == 3
    assert len({run(NATIVE, 2, law)[1] for law in LAWS}) == len(LAWS)


@pytest.fixture(scope="module", params=VERSIONS, ids=["fmi2", "fmi3"])
def exported(request, tmp_path_factory) -> Hosted:
    return hosted_controller(request.param, tmp_path_factory.mktemp("exported"))


def test_it_holds_a_library_for_each_platform(exported) -> None:
    with zipfile.ZipFile(exported.fmu) as container:
        held = {name for name in container.namelist() if name.startswith("binaries/")}
    version, identifier = exported.version, exported.identifier
    expected = {library(Path(), p, version, identifier).as_posix() for p in PLATFORMS}
    assert held == expected
    found = information(exported.fmu)["platforms"]
    assert found.pop("c-code") == ()
    assert found.keys() == {p.folder(f"{version}.0") for p in PLATFORMS}
    assert all(p.tuple in found[p.folder(f"{version}.0")] for p in PLATFORMS)
    assert fmpy.read_model_description(str(exported.fmu)).fmiVersion == f"{version}.0"


@pytest.fixture(scope="module")
def run_controller(exported):
    """Lines that the host prints on a platform; skipped where it cannot be run."""
    return cache(exported.run_or_skip)


@pytest.mark.parametrize("name", OTHERS)
def test_the_controllers_samples_are_bit_identical_to_the_native_ones(
    run_controller, name: str
) -> None:
    """States at random, so that working sets come and go and some QPs need many steps."""
    native, other = run_controller(NATIVE), run_controller(name)
    assert len(native) == STEPS + 1
    assert verdict(native, other) == "bit-identical"
