"""What the package depends on: bounded below, locked with all that it brings, in agreement."""

import re
import subprocess
import sys
import tomllib
from importlib.metadata import PackageNotFoundError, files, requires
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# Isolated, since pip's own warnings are not to be errors as ours are.
PIP = [sys.executable, "-I", "-m", "pip"]
# Not locked: a comparison that one example makes, in an environment of its own; what `dev` lacks.
UNLOCKED = {"outsiders", "torch"}
PLATFORMS = {
    "linux": ["manylinux_2_28_x86_64", "manylinux_2_17_x86_64", "manylinux2014_x86_64"],
    "darwin": ["macosx_14_0_arm64"],
    "win32": ["win_amd64"],
}


def direct():
    """Every requirement of the project, by extra."""
    extras = {"": PROJECT["dependencies"]} | PROJECT["optional-dependencies"]
    for extra, lines in extras.items():
        for line in lines:
            if (requirement := Requirement(line)).name != PROJECT["name"]:
                yield extra, requirement


def locked(platform):
    """Versions of constraints.txt on a platform, by name."""
    pins = {}
    for line in (ROOT / "constraints.txt").read_text().splitlines():
        pin = Requirement(line)
        assert re.fullmatch(r"==[\w.!+]+", str(pin.specifier)), f"{line}: not one exact version"
        if pin.marker is None or pin.marker.evaluate({"sys_platform": platform}):
            name = canonicalize_name(pin.name)
            assert name not in pins, f"{line}: locked twice"
            pins[name] = str(pin.specifier).removeprefix("==")
    return pins


def closure(locked=lambda extra: extra not in UNLOCKED):
    """Everything that the installed project and its extras need, by canonical name."""
    seen = set()
    left = [requirement for extra, requirement in direct() if locked(extra)]
    while left:
        requirement = left.pop()
        name = canonicalize_name(requirement.name)
        if (name, frozenset(requirement.extras)) in seen:
            continue
        try:
            needs = requires(name) or []
        except PackageNotFoundError:
            continue  # an extra that is not installed here
        seen.add((name, frozenset(requirement.extras)))
        for need in map(Requirement, needs):
            wanted = requirement.extras or {""}
            if need.marker is None or any(need.marker.evaluate({"extra": e}) for e in wanted):
                left.append(need)
    return {name for name, _ in seen}


def test_every_direct_dependency_has_a_lower_bound_and_no_upper_one():
    for _, requirement in direct():
        operators = [specifier.operator for specifier in requirement.specifier]
        assert operators == [">="], requirement


@pytest.mark.parametrize("platform", PLATFORMS)
def test_the_lock_satisfies_every_direct_dependency(platform):
    pins = locked(platform)
    for extra, requirement in direct():
        marker = requirement.marker
        if extra in UNLOCKED or (marker and not marker.evaluate({"sys_platform": platform})):
            continue
        version = pins.get(canonicalize_name(requirement.name))
        assert version is not None, f"{requirement} is not locked"
        assert requirement.specifier.contains(version), f"{requirement}, locked is {version}"


def test_the_lock_names_all_that_the_dependencies_bring():
    found = closure()
    assert len(found) > 40
    assert found - locked(sys.platform).keys() == set()


@pytest.mark.slow
def test_without_the_viewer_the_core_is_small():
    core = closure(lambda extra: not extra)
    assert len(core) > 30 and not core & {"rerun-sdk", "pyarrow"}
    paths = [path.locate() for name in core for path in files(name) or ()]
    assert sum(path.stat().st_size for path in paths if path.is_file()) < 0.9e9


@pytest.mark.slow
def test_what_is_installed_agrees():
    result = subprocess.run([*PIP, "check"], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr


# Once per release: it asks the registry for every package. On Linux the tests' own environment was
# installed from these pins.
@pytest.mark.campaign
@pytest.mark.parametrize("platform", ["darwin", "win32"])
def test_the_registry_has_a_wheel_of_every_locked_version(platform, tmp_path):
    pins = tmp_path / "constraints.txt"
    pins.write_text("".join(f"{name}=={version}\n" for name, version in locked(platform).items()))
    command = [*PIP, "install", "--dry-run", "--ignore-installed", "--quiet"]
    command += ["--disable-pip-version-check", "--only-binary=:all:", "--target", str(tmp_path)]
    command += ["--python-version", "3.11", "--implementation", "cp"]
    command += [word for abi in ("cp311", "abi3", "none") for word in ("--abi", abi)]
    command += [word for tag in PLATFORMS[platform] for word in ("--platform", tag)]
    command += ["-c", str(pins), *PROJECT["dependencies"]]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
