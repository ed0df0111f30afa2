"""The table of importers; each importer that is installed must pass, bit-identically."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path

import pytest

import fmus
from fmus import FmuError, checks
from fmus.checks import CHECKS, Status


@pytest.mark.slow
@pytest.mark.parametrize("name", fmus.NAMES)
def test_every_installed_importer_passes(name: str) -> None:
    findings = checks.check(fmus.path(name))
    assert [(f.tool, f.subject) for f in findings] == list(CHECKS)
    bad = (Status.FAILED, Status.CANNOT, Status.NOTED)
    assert [f for f in findings if f.status in bad] == []
    assert all(f.status is Status.PASSED for f in findings if f.tool in ("fmpy", "casadi"))


def test_missing_and_corrupt_files_are_errors(tmp_path: Path) -> None:
    with pytest.raises(FmuError, match="there is no file"):
        checks.check(tmp_path / "missing.fmu")
    (tmp_path / "corrupt.fmu").write_bytes(b"not a zip")
    with pytest.raises(FmuError, match="is not an FMU"):
        checks.check(tmp_path / "corrupt.fmu")


def test_importer_that_is_missing_is_reported_with_the_way_to_get_it(monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "ecospy", None)
    finding = checks.run("ecospy", "co-simulation", fmus.path())
    assert finding.status is Status.NOT_INSTALLED
    assert "fmi-check" in finding.detail


def test_interface_that_the_fmu_lacks_is_reported(tmp_path: Path) -> None:
    changed = rewrite(tmp_path, "<ModelExchange", "</ModelExchange>")
    finding = checks.run("fmpy", "model exchange, CVode", changed)
    assert finding.status is Status.NOT_OFFERED


def test_crash_of_an_importer_is_a_failure_of_that_importer_alone(monkeypatch) -> None:
    monkeypatch.setattr(checks.sys, "executable", shutil.which("false"))
    for tool, status in (("fmpy", Status.FAILED), ("ecospy", Status.CANNOT)):
        subject = {"fmpy": "validation", "ecospy": "co-simulation"}[tool]
        finding = checks._in_own_process(tool, subject, fmus.path())
        assert finding.status is status
        assert "ended with code 1" in finding.detail


def test_failed_validation_is_a_failure(tmp_path: Path) -> None:
    changed = rewrite(tmp_path, 'unit="kPa"', None, 'unit="nonsense"')
    finding = checks.run("fmpy", "validation", changed)
    assert finding.status is Status.FAILED
    assert "nonsense" in finding.detail


def rewrite(folder: Path, begin: str, end: str | None, text: str = "") -> Path:
    """A copy of the FMU whose description has everything from `begin` to `end` replaced."""
    target = folder / "changed.fmu"
    with zipfile.ZipFile(fmus.path()) as source, zipfile.ZipFile(target, "w") as container:
        for name in source.namelist():
            data = source.read(name)
            if name == "modelDescription.xml":
                description = data.decode()
                first = description.index(begin)
                last = first + len(begin) if end is None else description.index(end) + len(end)
                data = (description[:first] + text + description[last:]).encode()
            container.writestr(name, data)
    return target
