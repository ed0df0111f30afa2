"""TOML and JSON documents, read with one clear message for each way in which they can be wrong."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path
from typing import Any

LARGEST = 1 << 24
"""Bytes of the largest document that is read."""
DEEPEST = 32
"""Tables and lists within each other in a document."""


def read_toml(path: str | Path, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a TOML file; `origin` is what messages call it.

    Raises `error` where there is no such regular file, or where it is not UTF-8, not TOML, larger
    than `LARGEST` or nested deeper than `DEEPEST`.
    """
    return parse_toml(_text(path, origin, error), origin, error)


def read_json(path: str | Path, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a JSON file, an object; raises `error` as `read_toml` does."""
    return parse_json(_text(path, origin, error), origin, error)


def parse_json(text: str, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a JSON text; raises `error` where it is no object, or nested beyond `DEEPEST`."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as cause:
        raise error(f"{origin} is not valid JSON: {cause}") from None
    if not isinstance(document, dict):
        raise error(f"{origin} is not a JSON object")
    return _shallow(document, origin, error)


def _text(path: str | Path, origin: str, error: type[Exception]) -> str:
    try:
        if Path(path).exists() and not Path(path).is_file():
            raise error(f"{origin} is not a regular file")
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise error(f"{origin} does not exist") from None
    except (OSError, ValueError) as cause:
        reason = getattr(cause, "strerror", None) or cause
        raise error(f"{origin} cannot be read: {reason}") from None
    if len(content) > LARGEST:
        raise error(f"{origin} has {len(content)} bytes, more than any document of ours")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        raise error(f"{origin} is not UTF-8 text") from None


def parse_toml(text: str, origin: str, error: type[Exception]) -> dict[str, Any]:
    """Document of a TOML text; raises `error` where it is none, or nested beyond `DEEPEST`."""
    try:
        document = tomllib.loads(text)
    # Nesting without end exhausts the parser's stack, a number without end Python's patience.
    except (ValueError, RecursionError) as cause:
        raise error(f"{origin} is not valid TOML: {cause}") from None
    return _shallow(document, origin, error)


def _shallow(document: dict[str, Any], origin: str, error: type[Exception]) -> dict[str, Any]:
    """The document, unless it is nested beyond `DEEPEST`."""
    layer: list[Any] = [document]
    for _ in range(DEEPEST):
        layer = [
            inner
            for value in layer
            for inner in (value.values() if isinstance(value, dict) else value)
            if isinstance(inner, dict | list)
        ]
        if not layer:
            return document
    raise error(f"{origin} is nested more than {DEEPEST} deep")
