"""Finished work units on disk: an evaluation that was interrupted goes on where it stopped."""

from __future__ import annotations

import errno
import hashlib
import json
import os
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from cosim.errors import EvaluationError
from cosim.evaluation.unit import UnitResult, as_document, from_document
from cosim.files import parse_json

FILE = ".units.jsonl"
FORMAT = 3


class Store:
    """A line of JSON for each finished unit, under a hash of all that its results depend on.

    Without a folder nothing is stored. Lines are only ever added, each by one write that has
    reached the disk when `save` returns. A last line without end is what a killed process, or a
    full disk, has left of one: it counts for nothing. Only the process that started the evaluation
    writes, so workers need no shared disk.
    """

    def __init__(self, folder: Path | None) -> None:
        self._path = None if folder is None else folder / FILE
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)

    def load(self, keys: Collection[str]) -> Iterator[tuple[str, UnitResult]]:
        """What is stored under these keys; raises EvaluationError where a line is damaged."""
        if self._path is None or not self._path.exists():
            return
        if not self._path.is_file():
            raise EvaluationError(f"'{self._path}' is not a regular file; delete it")
        with self._path.open("rb") as stream:
            for number, line in enumerate(stream, start=1):
                if line.endswith(b"\n"):
                    key, result = self._read(line, number)
                    if key in keys:
                        yield key, result

    def _read(self, line: bytes, number: int) -> tuple[str, UnitResult]:
        try:
            document = parse_json(line.decode(), "the line", EvaluationError)
            if document.pop("sha256", None) != _digest(document):
                raise ValueError
            return str(document["key"]), from_document(document)
        except (EvaluationError, ValueError, KeyError, TypeError, AttributeError):
            raise EvaluationError(
                f"line {number} of the finished work units '{self._path}' is damaged; delete the "
                "line, or the file, to compute them again"
            ) from None

    def save(self, key: str, result: UnitResult) -> None:
        """Store a result, whole or not at all; raises OSError, which names the file."""
        if self._path is None:
            return
        document = {"key": key, **as_document(result)}
        document["sha256"] = _digest(document)
        line = json.dumps(document).encode() + b"\n"
        opened = os.open(self._path, os.O_RDWR | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        with os.fdopen(opened, "r+b", buffering=0) as stream:
            end = _whole(stream.fileno())
            stream.seek(end)
            stream.truncate()
            try:
                if stream.write(line) != len(line):
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                os.fsync(stream.fileno())
            except OSError as error:
                stream.truncate(end)
                error.filename = str(self._path)
                raise


def _whole(opened: int) -> int:
    """Bytes of an open file up to the end of its last whole line."""
    end = os.lseek(opened, 0, os.SEEK_END)
    while end:
        first = max(0, end - (1 << 16))
        os.lseek(opened, first, os.SEEK_SET)
        tail = os.read(opened, end - first)
        if (last := tail.rfind(b"\n")) >= 0:
            return first + last + 1
        end = first
    return 0


def _digest(document: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def unit_key(facts: Mapping[str, str | int | None]) -> str:
    """Key of a controller's units: a hash of the facts that their results depend on."""
    canonical = json.dumps({"format": FORMAT, **facts}, sort_keys=True)
    return hashlib.sha256(canonical.encode()).hexdigest()[:32]
