"""C source of CasADi functions, for the machine's own compiler and for FMUs."""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca

# Of two zeros of unlike sign CasADi's interpreter returns the first, the C library the second.
_TIES = (
    ("return fmax(x, y);", "return y > x || x != x ? y : x;"),
    ("return fmin(x, y);", "return y < x || x != x ? y : x;"),
)


def c_source(functions: Sequence[ca.Function]) -> str:
    """C99 source of the functions, which need nothing but the mathematical library.

    Each becomes `int NAME(const double** arg, double** res, long long* iw, double* w, int mem)`,
    with `NAME_work` for the sizes of its work vectors. Compiled without contraction of products
    and sums (-ffp-contract=off) and without fast-math it gives the interpreter's bytes. The same
    functions give the same source.
    """
    generator = ca.CodeGenerator("functions.c")
    for function in functions:
        generator.add(function)
    source = str(generator.dump())
    for library, interpreter in _TIES:
        source = source.replace(library, interpreter)
    return source
