from __future__ import annotations

import hashlib

import fmus
from fmus.build import PLATFORMS
from fmus.information import information


def test_tells_what_is_in_the_file(version: int) -> None:
    path = fmus.path(fmus.NAMES[version - 2])
    found = information(path)
    assert found.description.fmiVersion == f"{version}.0"
    assert set(found.flags) == {"co-simulation", "model exchange"}
    for flags in found.flags.values():
        assert flags["needsExecutionTool"] == "false"
        assert flags["canBeInstantiatedOnlyOncePerProcess"] == "false"
        plural = "" if version == 2 else "s"
        assert flags[f"providesDirectionalDerivative{plural}"] == "true"
        assert flags.get("providesAdjointDerivatives") == (None if version == 2 else "true")
    folders = {p.folder(f"{version}.0"): (p.tuple,) for p in PLATFORMS} | {"c-code": ()}
    if version == 2:
        folders["darwin64"] = ("x86_64-darwin", "aarch64-darwin")
    assert found.platforms == folders
    data = found.to_dict()
    assert [data[key] for key in ("start_time", "stop_time", "step_size")] == [0.0, 6000.0, 60.0]
    assert found.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    (pressure,) = [v for v in data["variables"] if v["name"] == "P100"]
    assert [pressure[key] for key in ("causality", "unit", "min")] == ["input", "kPa", "100.0"]
