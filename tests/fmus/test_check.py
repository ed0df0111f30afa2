"""The user's check of an FMU, and the independent importers that every FMU of ours must pass."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

import fmus
from fmus import CheckError, FmuError, check
from tests.helpers import importers


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


@pytest.mark.slow
@pytest.mark.parametrize("name", fmus.NAMES)
def test_every_installed_importer_passes(name: str) -> None:
    findings = importers.check(fmus.path(name))
    bad = (importers.FAILED, importers.CANNOT, importers.NOTED)
    assert [f for f in findings if f.status in bad] == []
    assert all(f.status == importers.PASSED for f in findings if f.tool in ("fmpy", "casadi"))


def test_the_shipped_files_pass(version: int) -> None:
    findings = check.check(fmus.path(fmus.NAMES[version - 2]))
    assert [f.status for f in findings] == ["passed"] * 3
    assert "bit-identical" in findings[-1].detail


def test_missing_and_corrupt_files_are_errors(tmp_path: Path) -> None:
    (tmp_path / "corrupt.fmu").write_bytes(b"not a zip")
    for name in ("missing.fmu", "corrupt.fmu"):
        with pytest.raises(FmuError):
            check.check(tmp_path / name)


def test_a_unit_that_is_not_defined_is_a_failure(tmp_path: Path) -> None:
    changed = rewrite(tmp_path, 'unit="kPa"', None, 'unit="nonsense"')
    finding = check.check(changed)[0]
    assert finding.status == "failed"
    assert "nonsense" in finding.detail


def test_the_reference_is_the_same_in_both_versions() -> None:
    assert np.array_equal(*(check.reference(fmus.path(name)) for name in fmus.NAMES))


def test_rounding_is_no_fault_of_an_own_fmu_but_one_of_the_shipped_files() -> None:
    rows = check.reference(fmus.path())
    rows[50, 0] = np.nextafter(rows[50, 0], 100.0)
    assert "equal to" in check.require_equal(rows, fmus.path(), check.ROUNDING)
    with pytest.raises(CheckError):
        check.require_equal(rows, fmus.path())


def test_relative_difference_has_a_floor_of_a_thousandth_of_the_signal() -> None:
    expected = np.array([[100.0], [0.0]])
    rows = np.array([[100.0], [0.01]])
    assert check.relative_difference(rows, expected) == pytest.approx(0.1)
