"""Generate the C header `variables.h` from a table of variables."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from fmus.model import Kind, Type, Variable

_TYPES = {
    Type.REAL: "REAL",
    Type.BOOLEAN: "BOOLEAN",
    Type.LAW: "LAW",
    Type.SEED: "SEED",
    Type.SEED_HIGH: "SEED_HIGH",
}
_KINDS = {
    Kind.INDEPENDENT: "INDEPENDENT",
    Kind.INPUT: "INPUT",
    Kind.STATE: "STATE",
    Kind.DERIVATIVE: "DERIVATIVE",
    Kind.OUTPUT: "OUTPUT",
    Kind.FIXED: "FIXED",
    Kind.TUNABLE: "TUNABLE",
}
_SEED_MAX = 4294967295.0


def c_header(token: str, variables: Sequence[Variable], origin: str) -> str:
    """The header's text: value references, types, starts and ranges, and the model's `token`."""
    references = "\n".join(f"    VR_{v.identifier} = {i}," for i, v in enumerate(variables))
    rows = "\n".join(f"    {_row(variable)}," for variable in variables)
    return f"""\
/* Generated {origin}; do not edit. */
#ifndef VARIABLES_H
#define VARIABLES_H

#define MODEL_TOKEN "{token}"

/* Digest of the variables' names and order: marks the layout of a serialised state. */
#define LAYOUT_DIGEST UINT64_C(0x{_layout_digest(variables)})

enum {{
{references}
    N_VARIABLES = {len(variables)}
}};

typedef enum {{ {", ".join(_TYPES.values())} }} VariableType;

typedef enum {{ {", ".join(_KINDS.values())} }} VariableKind;

typedef struct {{
    const char *name;
    VariableType type;
    VariableKind kind;
    double start, min, max, nominal;
}} VariableInfo;

static const VariableInfo VARIABLES[N_VARIABLES] = {{
{rows}
}};

#endif
"""


def _layout_digest(variables: Sequence[Variable]) -> str:
    names = "\n".join(variable.name for variable in variables)
    return hashlib.sha256(names.encode()).hexdigest()[:16]


def _row(variable: Variable) -> str:
    seed = variable.type in (Type.SEED, Type.SEED_HIGH)
    numbers = (
        variable.start,
        0.0 if seed else variable.min,
        _SEED_MAX if seed else variable.max,
        1.0 if variable.nominal is None else variable.nominal,
    )
    values = ", ".join(repr(float(number or 0.0)) for number in numbers)
    return f'{{"{variable.name}", {_TYPES[variable.type]}, {_KINDS[variable.kind]}, {values}}}'
