"""The controller as plain C for a micro-controller or PLC: one .c, one .h, an example, CMake."""

from __future__ import annotations

import re
from importlib.metadata import version
from pathlib import Path
from string import Template

from controllers.errors import ControllerError
from controllers.export.core import STATUSES, Core
from cosim.scenario import Scenario

TEMPLATES = Path(__file__).parent / "plain"
_INCLUDE = re.compile(r'^[ \t]*#include "(?P<name>[\w.]+)"[ \t]*\n', re.MULTILINE)
_C_NAME = re.compile(r"[A-Za-z]\w*")


def plain_c(core: Core, name: str, scenario: Scenario) -> dict[str, str]:
    """Text of ``NAME.c``, ``NAME.h``, ``main.c`` and ``CMakeLists.txt`` by file name.

    Raises ControllerError where `name`, with which the functions begin, is no C name.
    """
    if not _C_NAME.fullmatch(name):
        raise ControllerError(f"'{name}' is no name for C: letters, digits and _ only")
    problem = core.problem
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    guess = horizon * (2 * n + m)
    solution = (horizon + 1) * n + horizon * m + guess + 3
    words = [re.sub(r"\W", "_", text.replace("θ", "theta")).upper() for text in STATUSES]
    upper = name.upper()
    values = {
        "name": name,
        "Name": "".join(part.capitalize() for part in name.split("_")),
        "NAME": upper,
        "title": f"RTI-NMPC for {scenario.name}, theta {core.parameters.hash}",
        "version": version("rti-cosim"),
        "sampling_time": repr(float(scenario.sampling_time)),
        "n": n,
        "m": m,
        "states": ", ".join(scenario.plant.states),
        "actions": ", ".join(scenario.plant.actions),
        "parameters": core.parameters.blocks.size,
        "memory": guess + solution + 2 * m + 2,
        "statuses": ",\n".join(f"    {upper}_{word} = {k}" for k, word in enumerate(words)),
        "theta": ", ".join(repr(value) for value in core.parameters.theta.tolist()),
        "core": _joined(core),
    }
    names = {"controller.c": f"{name}.c", "controller.h": f"{name}.h"}
    return {
        names.get(path.name, path.name): Template(path.read_text(encoding="utf-8")).substitute(
            values
        )
        for path in sorted(TEMPLATES.iterdir())
    }


def _joined(core: Core) -> str:
    """`core.h` with each file that it includes in the place of its first inclusion."""
    files = {name: data.decode() for name, data in core.sources.items()}
    (rule,) = re.findall(r'#define HESSIAN_RULE "([\w.]+)"', files["problem.h"])
    text = files["core.h"].replace("#include HESSIAN_RULE", f'#include "{rule}"')
    seen: set[str] = set()

    def replace(found: re.Match[str]) -> str:
        if (name := found["name"]) in seen:
            return ""
        seen.add(name)
        return _INCLUDE.sub(replace, files[name])

    return _INCLUDE.sub(replace, text)
