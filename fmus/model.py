"""What an FMU of ours is made of: its variables, units and interfaces, for any model."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from enum import StrEnum
from functools import cache, cached_property
from pathlib import Path
from typing import Literal

FmiVersion = Literal[2, 3]
C_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")


class Kind(StrEnum):
    """What a variable is to an importer."""

    INDEPENDENT = "independent"
    INPUT = "input"
    STATE = "state"
    DERIVATIVE = "derivative"
    OUTPUT = "output"
    FIXED = "fixed parameter"
    TUNABLE = "tunable parameter"


class Type(StrEnum):
    """Value type.

    FMI 2.0 alone has `SEED_HIGH`, the upper half of the seed, and `LAW_NUMBER`, the law as an
    integer for tools that do not set enumerations (libcosim ignores them).
    """

    REAL = "Real"
    BOOLEAN = "Boolean"
    LAW = "Law"
    SEED = "Seed"
    SEED_HIGH = "SeedHigh"
    LAW_NUMBER = "LawNumber"


@dataclass(frozen=True)
class Variable:
    """One variable: its unit, range and the variables that its equation names (`uses`)."""

    name: str
    kind: Kind
    type: Type = Type.REAL
    unit: str = ""
    start: float | None = None
    min: float | None = None
    max: float | None = None
    nominal: float | None = None
    description: str = ""
    uses: tuple[str, ...] = ()

    @property
    def settable(self) -> bool:
        """Whether an importer gives its value (parameters and inputs)."""
        return self.kind in (Kind.INPUT, Kind.FIXED, Kind.TUNABLE)

    @property
    def identifier(self) -> str:
        """The name as a C identifier: ``der(X2)`` becomes ``der_X2``, ``p.x[0]`` ``p_x_0_``."""
        return re.sub(r"\W", "_", self.name.replace(")", ""))


def read_variables(file: Path) -> list[Variable]:
    """The table of variables in a CSV file with a column for each field of `Variable`."""

    def number(text: str) -> float | None:
        return float(text) if text else None

    with file.open(encoding="utf-8", newline="") as lines:
        return [
            Variable(
                row["name"],
                Kind[row["kind"]],
                Type[row["type"]],
                row["unit"],
                number(row["start"]),
                number(row["min"]),
                number(row["max"]),
                number(row["nominal"]),
                row["description"],
                tuple(row["uses"].split()),
            )
            for row in csv.DictReader(lines)
        ]


@dataclass(frozen=True)
class Unit:
    """A unit and its SI form: value_SI = factor · value + offset, with exponents of base units."""

    name: str
    factor: float = 1.0
    offset: float = 0.0
    exponents: tuple[tuple[str, int], ...] = ()

    def si(self) -> dict[str, object]:
        """The attributes of FMI's BaseUnit."""
        factor = self.factor if self.factor != 1.0 else None
        offset = self.offset if self.offset != 0.0 else None
        return {**dict(self.exponents), "factor": factor, "offset": offset}


@dataclass(frozen=True, eq=False)
class Model:
    """A model: its name, C identifier, table of variables with their units, and interfaces.

    A variable's value reference is its position in the table. `stop_time` and `step_size` [s] are
    the default experiment's; `model_exchange` and `derivatives` (directional, in FMI 3.0 adjoint,
    too) say what it offers beside co-simulation. Where it is `sampled`, it acts at the multiples of
    `step_size` alone: its outputs are discrete, and no communication step may pass over a sample.
    """

    name: str
    identifier: str
    version: str
    description: str
    variables: tuple[Variable, ...]
    units: tuple[Unit, ...]
    stop_time: float
    step_size: float
    model_exchange: bool = False
    derivatives: bool = False
    sampled: bool = False

    @cached_property
    def by_name(self) -> dict[str, Variable]:
        """Each variable by its name."""
        return {variable.name: variable for variable in self.variables}

    def value_reference(self, name: str) -> int:
        """The value reference of variable `name`; KeyError when there is none."""
        return self.variables.index(self.by_name[name])

    def names(self, *kinds: Kind) -> list[str]:
        """The names of the variables of these kinds, in table order."""
        return [variable.name for variable in self.variables if variable.kind in kinds]

    def exported(self, version: FmiVersion) -> list[Variable]:
        """The variables of the table that FMI `version` shows.

        FMI 3.0 has the whole seed in one variable; FMI 2.0 shows no time: FMI Library refuses it.
        """
        if version == 2:
            return [v for v in self.variables if v.kind is not Kind.INDEPENDENT]
        return [v for v in self.variables if v.type not in (Type.SEED_HIGH, Type.LAW_NUMBER)]


@cache
def closure(name: str, model: Model) -> frozenset[str]:
    """All variables that calculated variable `name` depends on, states not resolved further."""
    found: set[str] = set()
    for used in model.by_name[name].uses:
        found.add(used)
        if model.by_name[used].kind in (Kind.OUTPUT, Kind.DERIVATIVE):
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
