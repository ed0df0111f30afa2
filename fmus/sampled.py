"""FMUs of sampled systems, such as an exported controller: their C core between FMI's faces."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from fmus import BuildError
from fmus.build import assemble, sources_of
from fmus.evaporator import UNITS
from fmus.model import C_IDENTIFIER, FmiVersion, Kind, Model, Type, Unit, Variable

SOURCES = Path(__file__).parent / "sampled_sources"

_INFINITE = float("inf")
_LARGEST = sys.float_info.max
_SAMPLES = 100


@dataclass(frozen=True)
class Signal:
    """A real input, output or parameter by its `name`, with `unit`, `description` and range.

    `start` is what an input or a parameter begins with; `min` or `max` is None where there is none.
    """

    name: str
    unit: str
    description: str
    start: float | None = None
    min: float | None = None
    max: float | None = None

    def variable(self, kind: Kind, uses: tuple[str, ...] = ()) -> Variable:
        """The signal as a row of a table of variables; an output `uses` others."""
        low, high = [
            None if v in (None, -_INFINITE, _INFINITE) else v for v in (self.min, self.max)
        ]
        return Variable(
            self.name, kind, Type.REAL, self.unit, self.start, low, high, None, self.description,
            uses,
        )  # fmt: skip


@dataclass(frozen=True)
class SampledSystem:
    """A function of `inputs` and `parameters` that is evaluated once a `sampling_time` [s].

    `name` and `description` are for people, `identifier` is the model's C identifier. `sources`
    are C headers by name, of which ``core.h`` defines what ``sampled/sources/model_state.h`` lists;
    the arrays it is given and fills are ordered like `inputs`, `outputs` and `parameters`. Raises
    BuildError on an identifier that is none in C, on names that are taken twice and on a sampling
    time that is not positive.
    """

    name: str
    identifier: str
    description: str
    sampling_time: float
    inputs: tuple[Signal, ...]
    outputs: tuple[Signal, ...]
    parameters: tuple[Signal, ...]
    sources: Mapping[str, bytes]

    def __post_init__(self) -> None:
        """Check what the model description and the C header rely on."""
        if not C_IDENTIFIER.fullmatch(self.identifier):
            raise BuildError(f"'{self.identifier}' is not a C identifier")
        if not 0 < self.sampling_time < float("inf"):
            raise BuildError(f"the sampling time must be positive, not {self.sampling_time}")
        for names in ([v.name for v in self.variables], [v.identifier for v in self.variables]):
            if twice := next((name for name in names if names.count(name) > 1), None):
                raise BuildError(f"two variables of {self.name} are called '{twice}'")

    @cached_property
    def variables(self) -> tuple[Variable, ...]:
        """The table of variables; a value reference is a position in it.

        Every output follows every input at once, and every parameter.
        """
        time = Variable(
            "time", Kind.INDEPENDENT, Type.REAL, "s", None, None, None, None, "simulation time"
        )
        known = tuple(signal.name for signal in (*self.inputs, *self.parameters))
        return (
            time,
            *(signal.variable(Kind.INPUT) for signal in self.inputs),
            *(signal.variable(Kind.OUTPUT, known) for signal in self.outputs),
            *(signal.variable(Kind.TUNABLE) for signal in self.parameters),
        )

    @cached_property
    def model(self) -> Model:
        """The table with its units; one that `fmus.variables` does not know has no SI form."""
        known = {unit.name: unit for unit in UNITS}
        names = dict.fromkeys(variable.unit for variable in self.variables)
        return Model(
            name=self.name,
            identifier=self.identifier,
            version="1.0.0",
            description=self.description,
            variables=self.variables,
            units=tuple(known.get(name, Unit(name)) for name in names if name),
            stop_time=_SAMPLES * self.sampling_time,
            step_size=self.sampling_time,
            sampled=True,
        )

    @property
    def header(self) -> str:
        """The C header ``system.h``: where the groups of variables begin, and the sampling time."""
        first_output = 1 + len(self.inputs)
        first_parameter = first_output + len(self.outputs)
        return f"""\
/* Generated: the sampled system's groups of variables and its sampling time. */
#ifndef SYSTEM_H
#define SYSTEM_H

enum {{ FIRST_INPUT = 1, FIRST_OUTPUT = {first_output}, FIRST_PARAMETER = {first_parameter} }};

#define SAMPLING_TIME {float(self.sampling_time)!r}

#endif
"""

    def bounded(self) -> tuple[Variable, ...]:
        """The variables with a range for those that have none, which the C checks against."""
        return tuple(
            Variable(
                v.name, v.kind, v.type, v.unit, v.start,
                -_LARGEST if v.min is None else v.min, _LARGEST if v.max is None else v.max,
                v.nominal, v.description,
            )
            for v in self.variables
        )  # fmt: skip


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
