"""The user's check of an FMU, and the independent importers that every FMU of ours must pass."""

from __future__ import annotations

import pytest

import fmus
from benchmarks import importers
from fmus import check


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
    assert "all finite" in findings[-1].detail
