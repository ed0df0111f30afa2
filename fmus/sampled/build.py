"""Build the FMU of a sampled system: the C of its own between the shared FMI faces."""

from __future__ import annotations

import hashlib
import html
import uuid
from collections.abc import Mapping
from pathlib import Path

from fmus.build import SOURCES as SHARED_SOURCES
from fmus.documentation import RESOURCES
from fmus.header import c_header
from fmus.own import build_fmu
from fmus.sampled.description import sampled_description
from fmus.sampled.system import SampledSystem
from fmus.variables import FmiVersion

SOURCES = Path(__file__).parent / "sources"
SHARED = ("access.h", "exchange.h", "experiment.h", "grid.h", "instance.h", "snapshot.h")


def sampled_sources(system: SampledSystem, version: FmiVersion) -> dict[str, bytes]:
    """File name → bytes of the folder `sources/` of the FMU."""
    shared = [SHARED_SOURCES / name for name in (*SHARED, f"fmi{version}.c")]
    files = [*shared, *sorted(SOURCES.glob("*.h"))]
    sources = dict(system.sources) | {path.name: path.read_bytes() for path in files}
    sources["system.h"] = system.header.encode()
    sources["variables.h"] = _header(system, _token(system, version, sources)).encode()
    return sources


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
    sources = sampled_sources(system, version)
    own = {name: data for name, data in sources.items() if name != "variables.h"}
    token = _token(system, version, own)
    members = {
        "documentation/index.html": _page(system).encode(),
        "documentation/licenses/license.txt": (RESOURCES / "license.txt").read_bytes(),
        **(files or {}),
    }
    return build_fmu(
        target,
        sources,
        sampled_description(system, version, token),
        every_platform=every_platform,
        files=members,
    )


def _header(system: SampledSystem, token: str) -> str:
    return c_header(token, system.bounded(), f"from the variables of {system.name}")


def _token(system: SampledSystem, version: FmiVersion, sources: Mapping[str, bytes]) -> str:
    """GUID or instantiation token: a digest of all that makes the model."""
    digest = hashlib.sha256(sampled_description(system, version, "").encode())
    for name in sorted(sources):
        digest.update(name.encode() + b"\0" + sources[name])
    return "{" + str(uuid.UUID(bytes=digest.digest()[:16], version=5)) + "}"


def _page(system: SampledSystem) -> str:
    rows = "\n".join(
        f"<tr><td>{html.escape(v.name)}</td><td>{v.kind}</td><td>{html.escape(v.unit)}</td>"
        f"<td>{html.escape(v.description)}</td></tr>"
        for v in system.variables
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><title>{html.escape(system.name)}</title></head>
<body>
<h1>{html.escape(system.name)}</h1>
<p>{html.escape(system.description)}</p>
<p>Sampled every {system.sampling_time:g} s, at its multiples: a communication step ends at or
before the next one. At a sample the outputs follow the inputs at once; between samples they are
held. The model can be restored, serialised and instantiated many times.</p>
<table>
<tr><th>variable</th><th>kind</th><th>unit</th><th>meaning</th></tr>
{rows}
</table>
</body>
</html>
"""
