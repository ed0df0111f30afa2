"""Zip archives whose bytes repeat: sorted, uncompressed, with fixed dates and permissions."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

_DATE = (1980, 1, 1, 0, 0, 0)


def write_archive(files: Mapping[str, bytes], target: Path) -> Path:
    """Write `files`, by their path in the archive, to `target`, whole or not at all."""
    partial = target.with_name(f".{target.name}.partial")
    with zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as container:
        for name in sorted(files):
            entry = zipfile.ZipInfo(name, _DATE)
            entry.create_system = 3
            entry.external_attr = 0o100644 << 16
            container.writestr(entry, files[name])
    return partial.replace(target)


def read_archive(path: Path) -> dict[str, bytes]:
    """Every file in a zip archive by its path there."""
    with zipfile.ZipFile(path) as container:
        return {name: container.read(name) for name in container.namelist()}
