"""The controller's FMU for every platform: what it holds, and the bits where it can be run."""

from __future__ import annotations

import zipfile
from functools import cache
from pathlib import Path

import fmpy
import pytest

from fmus import PLATFORMS
from fmus.check import information
from tests.helpers.platforms import (
    MARKS,
    NATIVE,
    OTHERS,
    STEPS,
    VERSIONS,
    Hosted,
    hosted_controller,
    library,
    verdict,
)

pytestmark = MARKS


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
def run(exported):
    """Lines that the host prints on a platform; skipped where it cannot be run."""
    return cache(exported.run_or_skip)


@pytest.mark.parametrize("name", OTHERS)
def test_ten_thousand_samples_are_bit_identical_to_the_native_ones(run, name: str) -> None:
    """States at random, so that working sets come and go and some QPs need many steps."""
    native, other = run(NATIVE), run(name)
    assert len(native) == STEPS + 1
    assert verdict(native, other) == "bit-identical"
