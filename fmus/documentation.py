"""Generate the FMU's documentation page from its template and the table of variables."""

from __future__ import annotations

from html import escape
from pathlib import Path
from string import Template

from fmus.description import LICENSE
from fmus.model import FmiVersion, Variable
from fmus.variables import EVAPORATOR

RESOURCES = Path(__file__).parent / "resources"


def documentation_page(version: FmiVersion, build_file: str) -> str:
    """The text of documentation/index.html; `build_file` names the record of the build."""
    template = Template((RESOURCES / "documentation.html").read_text(encoding="utf-8"))
    return template.substitute(
        description=escape(EVAPORATOR.description),
        fmi_version=f"{version}.0",
        model_version=EVAPORATOR.version,
        license=LICENSE,
        diagram=(RESOURCES / "diagram.svg").read_text(encoding="utf-8"),
        rows="\n".join(_row(variable) for variable in EVAPORATOR.exported(version)),
        source=f"fmi{version}.c",
        build_file=build_file,
    )


def _row(variable: Variable) -> str:
    numbers = "".join(
        f'<td class="n">{_number(value)}</td>'
        for value in (variable.start, variable.min, variable.max)
    )
    reference = EVAPORATOR.value_reference(variable.name)
    return (
        f'<tr><td>{variable.name}</td><td class="n">{reference}</td>'
        f"<td>{variable.kind}</td><td>{escape(variable.unit)}</td>{numbers}"
        f"<td>{escape(variable.description)}</td></tr>"
    )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.10g}"
