"""Scenario documents: presets and TOML files, and what they extend, as one merged dictionary."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from cosim.errors import ScenarioError
from cosim.validation import suggestion


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
        text = files("cosim.presets").joinpath(f"{source}.toml").read_text("utf-8")
        folder = None
    elif path.suffix == ".toml" or len(path.parts) > 1 or path.is_file():
        origin = f"scenario file '{source}'"
        text = _text(path, origin)
        folder = path.resolve().parent
    else:
        raise ScenarioError(
            f"unknown scenario '{source}'{suggestion(str(source), presets())}; presets are "
            f"{', '.join(presets())}, or give the path of a TOML file"
        )
    try:
        document = tomllib.loads(text)
    # A document nested without end exhausts the parser's stack.
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ScenarioError(f"{origin}: not valid TOML: {error}") from None
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


def _text(path: Path, origin: str) -> str:
    try:
        return path.read_text("utf-8")
    except FileNotFoundError:
        raise ScenarioError(f"{origin} does not exist") from None
    except UnicodeDecodeError:
        raise ScenarioError(f"{origin} is not UTF-8 text") from None
    except OSError as error:
        raise ScenarioError(f"{origin} cannot be read: {error.strerror}") from None


def _extended(
    base: object, origin: str, folder: Path | None, seen: tuple[str, ...]
) -> dict[str, Any]:
    if not isinstance(base, str):
        raise ScenarioError(f"{origin}: extends must be a preset's name or a path, not {base!r}")
    if folder is not None and base not in presets():
        base = str(folder / base)
    if str(Path(base).resolve()) in seen:
        raise ScenarioError(f"{origin}: extends leads back to itself through '{base}'")
    return read(base, seen)[0]


def _anchor_fmu(document: dict[str, Any], folder: Path) -> None:
    """Make an FMU's relative path absolute, as seen from the scenario's folder."""
    plant = document.get("plant")
    if isinstance(plant, dict) and isinstance(plant.get("fmu"), str):
        fmu = Path(plant["fmu"])
        if fmu.suffix == ".fmu" or len(fmu.parts) > 1:
            plant["fmu"] = str(folder / fmu)
