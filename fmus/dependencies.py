"""Structural dependencies of the calculated variables, from the `uses` of the table."""

from __future__ import annotations

from functools import cache

from fmus.model import Kind, Model

_CALCULATED = (Kind.OUTPUT, Kind.DERIVATIVE)


@cache
def closure(name: str, model: Model) -> frozenset[str]:
    """All variables that calculated variable `name` depends on, states not resolved further."""
    found: set[str] = set()
    for used in model.by_name[name].uses:
        found.add(used)
        if model.by_name[used].kind in _CALCULATED:
            found |= closure(used, model)
    return frozenset(found)


def continuous_dependencies(name: str, model: Model) -> tuple[str, ...]:
    """States and inputs that `name` depends on during the simulation, in table order."""
    if model.by_name[name].kind is Kind.STATE:
        return (name,)
    known = closure(name, model)
    return tuple(n for n in model.names(Kind.STATE, Kind.INPUT) if n in known)


def initial_dependencies(name: str, model: Model) -> tuple[str, ...]:
    """Parameters and inputs that `name` depends on at initialisation, in table order."""
    names = set(closure(name, model))
    for state in [n for n in names if model.by_name[n].kind is Kind.STATE]:
        names |= closure(state, model)
    return tuple(v.name for v in model.variables if v.name in names and v.settable)
