"""Finished work units on disk: an evaluation that was interrupted goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cosim.errors import EvaluationError
from cosim.evaluation.unit import UnitResult, as_document, from_document
from rti_storage import write_atomically
from rti_storage.documents import read_json

FOLDER = ".units"
FORMAT = 2


class Store:
    """One small JSON file per finished unit, under a hash of all that its result depends on.

    Without a folder nothing is stored. Only the process that started the evaluation writes, so
    workers need no shared disk.
    """

    def __init__(self, folder: Path | None) -> None:
        self._folder = None if folder is None else folder / FOLDER
        if self._folder is not None:
            self._folder.mkdir(parents=True, exist_ok=True)

    def load(self, key: str) -> UnitResult | None:
        """The stored result, or None; raises EvaluationError where the file is damaged."""
        if self._folder is None or not (path := self._folder / f"{key}.json").is_file():
            return None
        try:
            document = read_json(path, f"'{path}'", EvaluationError)
            if document.pop("sha256", None) != _digest(document):
                raise ValueError
            return from_document(document)
        except (EvaluationError, ValueError, KeyError, TypeError, AttributeError):
            raise EvaluationError(
                f"the finished work unit '{path}' is damaged; delete it to compute it again"
            ) from None

    def save(self, key: str, result: UnitResult) -> None:
        """Store a result, whole or not at all."""
        if self._folder is not None:
            document = as_document(result)
            document["sha256"] = _digest(document)
            write_atomically(self._folder / f"{key}.json", json.dumps(document))


def _digest(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def unit_key(facts: Mapping[str, str | int | None]) -> str:
    """Name of a unit's file: a hash of the facts that its result depends on."""
    canonical = json.dumps({"format": FORMAT, **facts}, sort_keys=True)
    return hashlib.sha256(canonical.encode()).hexdigest()[:32]
