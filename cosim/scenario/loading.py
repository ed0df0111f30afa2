"""Scenario documents: presets and TOML files, and what they extend, as one merged dictionary."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from cosim.errors import ScenarioError
from cosim.files import parse_toml, read_toml
from cosim.validation import suggestion

LONGEST = 16
"""Files that may extend one another in a chain."""


def presets() -> list[str]:
    """Names of the scenarios that the package ships."""
    folder = files("cosim.presets")
    return sorted(
        entry.name.removesuffix(".toml")
        for entry in folder.iterdir()
        if entry.name.endswith(".toml")
    )


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The document with some fields changed: tables are merged, everything else is replaced."""
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        both_tables = isinstance(value, Mapping) and isinstance(old, Mapping)
        result[key] = merged(old, value) if both_tables else value  # type: ignore[arg-type]
    return result


def read(source: str | Path, seen: tuple[str, ...] = ()) -> tuple[dict[str, Any], str]:
    """Read a preset or file and what it extends; returns the document and its origin's name.

    `seen` are the files that led here. An FMU's relative path is made absolute, as seen from the
    file that names it. Raises ScenarioError.
    """
    path = Path(source)
    if str(source) in presets():
        origin = f"preset '{source}'"
        preset = files("cosim.presets").joinpath(f"{source}.toml").read_text("utf-8")
        document, folder = parse_toml(preset, origin, ScenarioError), None
    elif path.suffix == ".toml" or len(path.parts) > 1 or _is_file(path):
        origin = f"scenario file '{source}'"
        document, folder = read_toml(path, origin, ScenarioError), path.resolve().parent
    else:
        raise ScenarioError(
            f"unknown scenario '{source}'{suggestion(str(source), presets())}; presets are "
            f"{', '.join(presets())}, or give the path of a TOML file"
        )
    return resolved(document, origin, folder, (*seen, str(path.resolve()))), origin


def resolved(
    document: Mapping[str, Any], origin: str, folder: Path | None, seen: tuple[str, ...] = ()
) -> dict[str, Any]:
    """The document with what it `extends`, its paths made absolute as seen from `folder`.

    `seen` are the files that led here. Raises ScenarioError.
    """
    result = copy.deepcopy(dict(document))
    if folder is not None:
        _anchor_fmu(result, folder)
    if (base := result.pop("extends", None)) is not None:
        result = merged(_extended(base, origin, folder, seen), result)
    return result


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name that no file can have
        return False


def _extended(
    base: object, origin: str, folder: Path | None, seen: tuple[str, ...]
) -> dict[str, Any]:
    if not isinstance(base, str):
        raise ScenarioError(f"{origin}: extends must be a preset's name or a path, not {base!r}")
    if folder is not None and base not in presets():
        base = str(folder / base)
    if "\0" in base:
        raise ScenarioError(f"{origin}: extends must be a path, not {base!r}")
    if str(Path(base).resolve()) in seen:
        raise ScenarioError(f"{origin}: extends leads back to itself through '{base}'")
    if len(seen) > LONGEST:
        raise ScenarioError(f"{origin}: extends another file more than {LONGEST} times over")
    return read(base, seen)[0]


def _anchor_fmu(document: dict[str, Any], folder: Path) -> None:
    """Make an FMU's relative path absolute, as seen from the scenario's folder."""
    plant = document.get("plant")
    if isinstance(plant, dict) and isinstance(plant.get("fmu"), str):
        fmu = Path(plant["fmu"])
        if fmu.suffix == ".fmu" or len(fmu.parts) > 1:
            plant["fmu"] = str(folder / fmu)
