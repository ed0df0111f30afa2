"""A model's table and its C put into an FMU: what plants and sampled systems have in common."""

from __future__ import annotations

import hashlib
import uuid
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

from fmus.build import SOURCES
from fmus.description import build_description, model_description
from fmus.documentation import RESOURCES
from fmus.header import c_header
from fmus.model import FmiVersion, Model, Variable
from fmus.own import build_fmu

PLANT_SOURCES = Path(__file__).parent / "plant_sources"
# Of the evaporator's sources what serves any model: FMI's faces, and what they are made of.
FACES = ("access.h", "exchange.h", "experiment.h", "grid.h", "instance.h", "snapshot.h")
WITHOUT_DERIVATIVES = ("adjoint.h", "derivatives.h")


def sources_of(
    model: Model,
    version: FmiVersion,
    own: Mapping[str, bytes],
    rows: Sequence[Variable] | None = None,
) -> dict[str, bytes]:
    """File name → bytes of the folder `sources/` of an FMU without derivatives.

    `own` is the model's own C; `rows` is its table as the C shall check it, where that differs.
    """
    paths = [SOURCES / name for name in (*FACES, f"fmi{version}.c")]
    paths += [PLANT_SOURCES / name for name in WITHOUT_DERIVATIVES]
    files = {path.name: path.read_bytes() for path in paths} | dict(own)
    variables = model.variables if rows is None else rows
    header = c_header(_token(model, version, files), variables, f"from the table of {model.name}")
    files["variables.h"] = header.encode()
    files["buildDescription.xml"] = build_description(version, model).encode()
    return files


def assemble(
    model: Model,
    version: FmiVersion,
    sources: Mapping[str, bytes],
    target: str | Path,
    *,
    remarks: str = "",
    every_platform: bool = False,
    files: Mapping[str, bytes] | None = None,
) -> Path:
    """Build the FMU `target` of what `sources_of` found, with a page that shows its table.

    `remarks` are sentences on that page, `files` further members of the archive. As
    `fmus.own.build_fmu`, whose BuildError it raises; with the same compiler the bytes repeat.
    """
    generated = ("variables.h", "buildDescription.xml")
    written = {name: data for name, data in sources.items() if name not in generated}
    members = {
        "documentation/index.html": _page(model, version, remarks).encode(),
        "documentation/licenses/license.txt": (RESOURCES / "license.txt").read_bytes(),
        **(files or {}),
    }
    text = model_description(version, _token(model, version, written), model)
    return build_fmu(target, sources, text, every_platform=every_platform, files=members)


def _token(model: Model, version: FmiVersion, sources: Mapping[str, bytes]) -> str:
    """GUID or instantiation token: a digest of all that makes the model."""
    digest = hashlib.sha256(model_description(version, "", model).encode())
    for name in sorted(sources):
        digest.update(name.encode() + b"\0" + sources[name])
    return "{" + str(uuid.UUID(bytes=digest.digest()[:16], version=5)) + "}"


def _page(model: Model, version: FmiVersion, remarks: str) -> str:
    rows = "\n".join(
        f"<tr><td>{escape(v.name)}</td><td>{v.kind}</td><td>{escape(v.unit)}</td>"
        f"<td>{escape(v.description)}</td></tr>"
        for v in model.exported(version)
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head><meta charset="utf-8"><title>{escape(model.name)}</title></head>
<body>
<h1>{escape(model.name)}</h1>
<p>{escape(model.description)}</p>
<p>{escape(remarks)} The model can be restored, serialised and instantiated many times.</p>
<table>
<tr><th>variable</th><th>kind</th><th>unit</th><th>meaning</th></tr>
{rows}
</table>
</body>
</html>
"""
