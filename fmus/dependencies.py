"""Structural dependencies of the calculated variables, from the `uses` of the table."""

from __future__ import annotations

from functools import cache

from fmus.variables import BY_NAME, VARIABLES, Kind

_CALCULATED = (Kind.OUTPUT, Kind.DERIVATIVE)


@cache
def closure(name: str) -> frozenset[str]:
    """All variables that calculated variable `name` depends on, states not resolved further."""
    found: set[str] = set()
    for used in BY_NAME[name].uses:
        found.add(used)
        if BY_NAME[used].kind in _CALCULATED:
            found |= closure(used)
    return frozenset(found)


def continuous_dependencies(name: str) -> tuple[str, ...]:
    """States and inputs that `name` depends on during the simulation, in table order."""
    if BY_NAME[name].kind is Kind.STATE:
        return (name,)
    return tuple(
        v.name for v in VARIABLES if v.name in closure(name) and v.kind in (Kind.STATE, Kind.INPUT)
    )


def initial_dependencies(name: str) -> tuple[str, ...]:
    """Parameters and inputs that `name` depends on at initialisation, in table order."""
    names = set(closure(name))
    for state in [n for n in names if BY_NAME[n].kind is Kind.STATE]:
        names |= closure(state)
    return tuple(v.name for v in VARIABLES if v.name in names and v.settable)
