from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

import fmus
from fmus.errors import FmuError
from fmus.information import information


def test_tells_what_is_in_the_file(version: int) -> None:
    path = fmus.path(fmus.NAMES[version - 2])
    found = information(path)
    assert found.fmi_version == f"{version}.0"
    assert found.interfaces == ("co-simulation", "model exchange")
    assert "directional derivatives" in found.capabilities
    assert ("adjoint derivatives" in found.capabilities) == (version == 3)
    assert (found.start_time, found.stop_time, found.step_size) == (0.0, 6000.0, 60.0)
    assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    (pressure,) = [v for v in found.variables if v.name == "P100"]
    assert (pressure.causality, pressure.unit, pressure.min) == ("input", "kPa", "100.0")


def test_missing_and_corrupt_files_are_errors(tmp_path: Path) -> None:
    with pytest.raises(FmuError, match="there is no file"):
        information(tmp_path / "missing.fmu")
    (tmp_path / "corrupt.fmu").write_bytes(b"not a zip")
    with pytest.raises(FmuError, match="is not an FMU"):
        information(tmp_path / "corrupt.fmu")
