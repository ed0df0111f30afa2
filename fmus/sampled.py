"""FMUs of sampled systems, such as an exported controller: their C core between FMI's faces."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from fmus import BuildError
from fmus.build import SOURCES, assemble, files_of, sources_of
from fmus.model import FmiVersion, FmuModel, Kind, Variable, render, unit


def sampled_system(
    *,
    name: str,
    identifier: str,
    description: str,
    sampling_time: float,
    signals: Sequence[Variable],
    sources: Mapping[str, bytes],
    terminal: tuple[str, ...] = (),
) -> FmuModel:
    """The model of a function of inputs and parameters, evaluated once a `sampling_time` [s].

    `signals` are real variables, or Boolean inputs: the inputs, then the outputs, then the tunable
    parameters; every output depends on every input and parameter. `sources` are C headers by name,
    of which ``core.h`` defines the functions that ``sampled_sources/model_state.h`` lists; their
    arrays are ordered like the signals. Raises BuildError on names that are taken twice, in FMI or
    in C.
    """
    time = Variable("time", Kind.INDEPENDENT, unit="s", description="simulation time")
    known = tuple(v.name for v in signals if v.settable)
    table = (time, *(v if v.settable else replace(v, uses=known) for v in signals))
    for names in ([v.name for v in table], [v.identifier for v in table]):
        if twice := next((each for each in names if names.count(each) > 1), None):
            raise BuildError(f"two variables of {name} are called '{twice}'")
    return FmuModel(
        name=name,
        identifier=identifier,
        description=description,
        variables=table,
        units=tuple(unit(each) for each in dict.fromkeys(v.unit for v in table) if each),
        stop_time=100 * sampling_time,
        step_size=sampling_time,
        sampled=True,
        terminal=terminal,
        sources=sources,
    )


def sampled_sources(system: FmuModel, version: FmiVersion) -> dict[str, bytes]:
    """File name → bytes of the folder `sources/` of a sampled system's FMU."""
    kinds = [variable.kind for variable in system.variables]
    first_output = 1 + kinds.count(Kind.INPUT)
    header = render(
        "system.h",
        first_output=first_output,
        first_parameter=first_output + kinds.count(Kind.OUTPUT),
        sampling_time=float(system.step_size),
    )
    own = files_of("sampled_sources") | {**system.sources, "system.h": header.encode()}
    if version == 3:
        own |= _array_sources(system)
    # The C checks every variable against a range.
    largest = sys.float_info.max
    rows = [
        replace(
            v, min=-largest if v.min is None else v.min, max=largest if v.max is None else v.max
        )
        for v in system.variables
    ]
    return sources_of(system, version, own, rows)


def _array_sources(model: FmuModel) -> dict[str, bytes]:
    """FMI 3.0's functions for scalars, and the adapter for the model's arrays."""
    elements = dict.fromkeys(range(len(model.variables)), (1, 0))
    for array in model.arrays.values():
        own = [model.value_reference(variable.name) for variable in array]
        for k, vr in enumerate(own):
            elements[vr] = (0 if k else len(own), own[(k + 1) % len(own)])
    table = render("arrays.h", model=model, elements=elements.values()).encode()
    last = b'#include "snapshot.h"\n'
    face = (SOURCES / "fmi3.c").read_bytes().replace(last, last + b'#include "arrays.h"\n')
    return {"arrays.h": table, "fmi3.c": face}


def build_sampled(
    system: FmuModel,
    target: str | Path,
    version: FmiVersion = 2,
    *,
    every_platform: bool = False,
    files: Mapping[str, bytes] | None = None,
) -> Path:
    """Build the FMU `target` of a sampled system; `files` are further members of the archive.

    As `fmus.build.build_fmu`, whose BuildError it raises; with the same compiler the bytes repeat.
    """
    return assemble(
        system,
        version,
        sampled_sources(system, version),
        target,
        remarks=(
            f"Sampled every {system.step_size:g} s, at its multiples: a communication step "
            "ends at or before the next one. At a sample the outputs follow the inputs at once; "
            "between samples they are held."
        ),
        every_platform=every_platform,
        files=files,
    )
