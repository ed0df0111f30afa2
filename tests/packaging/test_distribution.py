"""The sdist and the wheel made of it, in a virtual environment outside the checkout."""

import hashlib
import json
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import Distribution, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

import fmus

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
PRESETS = {"paper", "nominal", "fast-sampling", "fouled", "mismatched", "drifting", "jump"}
PRESETS |= {"reactor", "tanks", "holdup", "slow-sampling", "dead-time", "unstable-reactor"}
PRESETS |= {"coloured-2", "coloured-5", "coloured-10", "assay", "assay-fouled", "late", "levels"}
PRESETS |= {"prices", "set-point", "forecast"}


# Other people's tools may warn; what is installed may not.
TOOLS = {name: value for name, value in os.environ.items() if name != "PYTHONWARNINGS"}


def run(*command, cwd, env=TOOLS):
    result = subprocess.run(
        [*map(str, command)], cwd=cwd, env=env, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, f"{command}\n{result.stdout}\n{result.stderr}"
    return result.stdout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """The committed files alone, where a build leaves no trace in the work tree."""
    folder = tmp_path_factory.mktemp("checkout")
    archive = folder.with_suffix(".tar")
    run("git", "archive", "-o", archive, "HEAD", cwd=ROOT)
    with tarfile.open(archive) as tar:
        tar.extractall(folder, filter="data")
    return folder


@pytest.fixture(scope="module")
def python(tmp_path_factory):
    """Interpreter of an empty virtual environment."""
    folder = tmp_path_factory.mktemp("venv")
    run(sys.executable, "-m", "venv", folder, cwd=folder)
    return folder / "bin" / "python"


@pytest.fixture(scope="module")
def sdist(checkout, python, tmp_path_factory):
    folder = tmp_path_factory.mktemp("sdist")
    run(python, "-m", "pip", "install", "--quiet", "setuptools>=77", cwd=folder)
    code = f"from setuptools import build_meta; print(build_meta.build_sdist({str(folder)!r}))"
    name = run(python, "-c", code, cwd=checkout).strip().splitlines()[-1]
    return folder / name


@pytest.fixture(scope="module")
def wheel(sdist, python):
    folder = sdist.parent / "wheel"
    run(python, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, sdist, cwd=sdist.parent)
    (path,) = folder.glob("*.whl")
    return path


def dependencies(wheel: Path) -> list[Distribution]:
    """What a wheel asks for, without its extras, and what that asks for in turn, as it is here."""
    needed: dict[str, Distribution] = {}

    def follow(lines: list[str], extras: set[str]) -> None:
        for requirement in map(Requirement, lines):
            marker = requirement.marker
            environments = [{"extra": extra} for extra in extras or {""}]
            if marker is not None and not any(map(marker.evaluate, environments)):
                continue
            there = distribution(requirement.name)
            if there.name not in needed:
                assert there.version in requirement.specifier
                needed[there.name] = there
                follow(there.requires or [], requirement.extras)

    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        lines = archive.read(name).decode().partition("\n\n")[0].splitlines()
    prefix = "Requires-Dist: "
    follow([line.removeprefix(prefix) for line in lines if line.startswith(prefix)], set())
    return list(needed.values())


@pytest.fixture(scope="module")
def installed(wheel, python):
    """Interpreter with the wheel and what it says that it depends on, and nothing else.

    The dependencies are links to those that the tests run with, which pip put there by the lock.
    """
    run(python, "-m", "pip", "install", "--quiet", "--no-deps", wheel, cwd=wheel.parent)
    code = "import sysconfig; print(sysconfig.get_path('platlib'))"
    packages = Path(run(python, "-c", code, cwd=wheel.parent).strip())
    for dependency in dependencies(wheel):
        for entry in {file.parts[0] for file in dependency.files} - {"..", "__pycache__"}:
            if not (packages / entry).exists():
                (packages / entry).symlink_to(dependency.locate_file(entry))
    return python


@pytest.fixture(scope="module")
def with_viewer(installed, wheel):
    """The same environment, and the viewer of recordings in it."""
    extra = f"rti-cosim[view] @ {wheel.as_uri()}"
    lock = ROOT / "constraints.txt"
    run(installed, "-m", "pip", "install", "--quiet", "-c", lock, extra, cwd=wheel.parent)
    return installed


def bare_environment(python):
    """A path on which there is no compiler, and nothing that leads back to the checkout."""
    home = os.environ.get("HOME", "/")
    return {"PATH": str(python.parent), "HOME": home, "PYTHONWARNINGS": "error"}


def test_the_sdist_holds_what_a_fork_needs(sdist):
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    expected = {"constraints.txt", "Makefile", "results/learning.toml", "tests/faults"}
    assert expected <= names
    assert not {name for name in names if name.endswith((".rrd", ".pyc"))}
    assert not {name for name in names if name.startswith("results/") and "/figures/" in name}


def test_the_wheel_holds_the_committed_data_to_the_byte(wheel, checkout):
    with zipfile.ZipFile(wheel) as archive:
        stored = {name: archive.read(name) for name in archive.namelist()}
    packages = ("fmus", "cosim", "controllers", "learning")
    assert {f"{package}/py.typed" for package in packages} <= stored.keys()
    patterns = (
        "fmus/*.fmu", "fmus/sources/*", "fmus/plant_sources/*", "fmus/resources/*",
        "fmus/templates/*", "cosim/presets/*.toml", "cosim/skeletons/*/*",
    )  # fmt: skip
    files = [path for pattern in patterns for path in checkout.glob(pattern)]
    assert len(files) > 20
    for path in files:
        assert stored[str(path.relative_to(checkout))] == path.read_bytes()
    assert not {
        name for name in stored if name.startswith("cosim/results/") and "/figures/" in name
    }
    tables = [path.relative_to(checkout) for path in checkout.glob("results/**/*.csv")]
    assert tables
    for path in tables:
        assert stored[f"cosim/{path}"] == (checkout / path).read_bytes()
    sources = {
        str(path.relative_to(checkout))
        for package in packages
        for path in (checkout / package).rglob("*.py")
    }
    assert sources == {name for name in stored if name.endswith(".py")}


def test_an_index_can_follow_every_link_of_the_description(wheel):
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/METADATA"))
        description = archive.read(name).decode()
    assert "## Install and run" in description
    assert re.findall(r"\]\((?!https://).*?\)", description) == []


def test_the_command_works_outside_the_checkout(installed, tmp_path):
    env = bare_environment(installed)
    version = run(installed.parent / "cosim", "--version", cwd=tmp_path, env=env)
    digest = hashlib.sha256(fmus.path().read_bytes()).hexdigest()
    assert f"evaporator.fmu sha256 {digest}" in version
    presets = run(installed, "-m", "cosim", "scenario", "--json", cwd=tmp_path, env=env)
    assert set(json.loads(presets)["presets"]) == PRESETS


def test_a_run_needs_no_compiler(installed, tmp_path):
    env = bare_environment(installed)
    env["COSIM_CACHE"] = str(tmp_path / "cache")
    words = ("simulate", "--steps", "1000", "--json", "--out", "run")
    summary = json.loads(run(installed, "-m", "cosim", *words, cwd=tmp_path, env=env))
    assert (summary["failures"], summary["samples"]) == (0, 1000)
    assert summary["timing"]["functions"] == "compiled"


def test_the_installed_results_hold(installed, tmp_path):
    env = bare_environment(installed)
    words = ("results", "check", "closed-loop", "--json")
    result = json.loads(run(installed, "-m", "cosim", *words, cwd=tmp_path, env=env))
    assert result["same"] is True


def test_without_the_viewer_a_recording_says_what_to_install(installed, tmp_path):
    words = [installed, "-m", "cosim", "simulate", "--steps", "20", "--record", "--out", "run"]
    environment = bare_environment(installed)
    result = subprocess.run(
        words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert result.returncode == 2
    assert result.stderr.splitlines()[-1].startswith("error: ")
    assert "rti-cosim[view]" in result.stderr


def test_without_the_viewer_the_demo_runs_and_records_nothing(installed, tmp_path):
    env = bare_environment(installed)
    words = ("demo", "--samples", "100", "--steps", "20", "--out", "demo", "--json")
    run(installed, "-m", "cosim", *words, cwd=tmp_path, env=env)
    assert (tmp_path / "demo" / "before-after.png").is_file()
    assert not list((tmp_path / "demo").rglob("*.rrd"))


def test_with_the_viewer_a_run_is_recorded(with_viewer, tmp_path):
    env = bare_environment(with_viewer)
    words = ("simulate", "--steps", "20", "--record", "--json", "--out", "run")
    run(with_viewer, "-m", "cosim", *words, cwd=tmp_path, env=env)
    assert (tmp_path / "run" / "run.rrd").stat().st_size > 10_000
