"""The user's check of an FMU, and the independent importers that every FMU of ours must pass."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import fmpy
import numpy as np
import pytest

import fmus
from benchmarks import importers
from cosim.plant.check import check_plant
from cosim.plant.probe import Restart
from fmus import build, evaporator
from fmus.build import compilers
from tests.helpers import crosscheck
from tests.helpers.compiler import needs_compiler

needs_zig = pytest.mark.skipif(
    importlib.util.find_spec("ziglang") is None, reason="the extra 'cross' is not installed"
)


def shipped_record(name: str = "evaporator") -> dict:
    with zipfile.ZipFile(fmus.path(name)) as container:
        return json.loads(container.read(evaporator.BUILD_FILE))


def build_elsewhere(root: Path, every_platform: bool) -> Path:
    """Both FMUs, built by a copy of the packages in another folder."""
    ignored = shutil.ignore_patterns("__pycache__", "*.fmu", "*.npz")
    for name in ("fmus", "cosim", "controllers", "learning"):  # none may hide another
        shutil.copytree(evaporator.PACKAGE.parent / name, root / name, ignore=ignored)
    (root / "fmus" / "sources" / "variables.h").unlink()
    code = (
        "import pathlib, sys, fmus.evaporator as e; "
        "e.build_evaporator(pathlib.Path('out'), len(sys.argv) > 1)"
    )
    subprocess.run([sys.executable, "-c", code, *["all"] * every_platform], cwd=root, check=True)
    return root / "out"


@needs_zig
@pytest.mark.slow
def test_clean_build_elsewhere_equals_the_shipped_files(tmp_path: Path) -> None:
    """Every platform's binary, byte for byte."""
    used = [each.version for each in compilers(every_platform=True)]
    if used != [entry["compiler"] for entry in shipped_record()["platforms"].values()]:
        pytest.skip("another cross-compiler than the one of the shipped binaries")
    built = build_elsewhere(tmp_path, every_platform=True)
    for name in fmus.NAMES:
        assert evaporator.differences(built / f"{name}.fmu", fmus.path(name)) == []


@pytest.mark.slow
@needs_compiler
def test_two_local_builds_are_byte_identical(tmp_path: Path) -> None:
    """And differ from the shipped files in nothing but binaries and the record of the build.

    Another compiler, the same bits: the seeded normal law with fouling among them.
    """
    elsewhere = build_elsewhere(tmp_path / "clean checkout", every_platform=False)
    for path in evaporator.build_evaporator(tmp_path / "here"):
        assert path.read_bytes() == (elsewhere / path.name).read_bytes()
        differing = evaporator.differences(path, fmus.path(path.stem))
        assert {name for name in differing if not name.startswith("binaries/")} == {
            evaporator.BUILD_FILE
        }
        crosscheck.hold(path)


@needs_compiler
@pytest.mark.slow  # two builds by cmake
@pytest.mark.parametrize("fmi", [2, 3])
def test_source_only_copy_builds_through_fmpy(tmp_path: Path, fmi: int) -> None:
    from fmpy.build import build_platform_binary

    search = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    if shutil.which("cmake", path=search) is None:
        pytest.skip("there is no cmake")
    name = fmus.NAMES[fmi - 2]
    folder = tmp_path / "unzipped"
    fmpy.extract(str(fmus.path(name)), str(folder))
    shutil.rmtree(folder / "binaries")
    options = {
        "CMAKE_C_FLAGS:STRING": f"-ffp-contract=off -DFMI{fmi}_OVERRIDE_FUNCTION_PREFIX",
        "CMAKE_C_STANDARD_LIBRARIES": "-lm",
    }
    old = os.environ["PATH"]
    os.environ["PATH"] = search
    try:
        # A build folder of our own: fmpy leaves it to the garbage collector to delete its own.
        (tmp_path / "build").mkdir()
        build_platform_binary(str(folder), build_dir=tmp_path / "build", cmake_options=options)
    finally:
        os.environ["PATH"] = old
    experiment = {"stop_time": 600.0, "output_interval": 60.0, "fmi_type": "CoSimulation"}
    ours = fmpy.simulate_fmu(str(fmus.path(name)), **experiment)
    theirs = fmpy.simulate_fmu(str(folder), **experiment)
    assert np.array_equal(ours, theirs)


def test_committed_header_is_not_stale() -> None:
    committed = (build.SOURCES / build.HEADER).read_bytes()
    remedy = "run `cosim fmu build --in-place` and commit what it writes"
    assert committed == build.sources_of(evaporator.EVAPORATOR, 2)[build.HEADER], remedy


@pytest.mark.slow
@pytest.mark.parametrize("name", fmus.NAMES)
def test_every_installed_importer_passes(name: str) -> None:
    findings = importers.check(fmus.path(name))
    bad = (importers.FAILED, importers.CANNOT, importers.NOTED)
    assert [f for f in findings if f.status in bad] == []
    assert all(f.status == importers.PASSED for f in findings if f.tool in ("fmpy", "casadi"))


@pytest.mark.parametrize("name", (*fmus.NAMES, *fmus.PLANTS))
def test_the_shipped_files_can_be_plants(name: str) -> None:
    found = check_plant(name)
    assert (found.usable, found.remarks) == (True, ())
    assert found.report is not None
    assert (found.report.restart, found.report.still) == (Restart.RESET, {})
    assert found.report.snapshots and found.report.serialises
