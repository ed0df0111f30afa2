"""Build the FMU of a sampled system: the C of its own between the shared FMI faces."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from fmus.assembly import assemble, sources_of
from fmus.model import FmiVersion
from fmus.sampled.system import SampledSystem

SOURCES = Path(__file__).parent / "sources"


def sampled_sources(system: SampledSystem, version: FmiVersion) -> dict[str, bytes]:
    """File name → bytes of the folder `sources/` of the FMU."""
    own = {path.name: path.read_bytes() for path in sorted(SOURCES.glob("*.h"))}
    own |= {**system.sources, "system.h": system.header.encode()}
    return sources_of(system.model, version, own, system.bounded())


def build_sampled(
    system: SampledSystem,
    target: str | Path,
    version: FmiVersion = 2,
    *,
    every_platform: bool = False,
    files: Mapping[str, bytes] | None = None,
) -> Path:
    """Build the FMU `target` of a sampled system; `files` are further members of the archive.

    As `fmus.own.build_fmu`, whose BuildError it raises; with the same compiler the bytes repeat.
    """
    return assemble(
        system.model,
        version,
        sampled_sources(system, version),
        target,
        remarks=(
            f"Sampled every {system.sampling_time:g} s, at its multiples: a communication step "
            "ends at or before the next one. At a sample the outputs follow the inputs at once; "
            "between samples they are held."
        ),
        every_platform=every_platform,
        files=files,
    )
