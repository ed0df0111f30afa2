"""A plant of one's own as an FMU: a table of variables in Python, the equations in C, no more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from fmus.build import PLANT_SOURCES, SOURCES, assemble, sources_of
from fmus.model import LAW_NUMBER, SATURATE, FmiVersion, Kind, Model, Type, Unit, Variable

# Of the evaporator's sources what serves any plant; the rest is its own or generated.
_SHARED = (
    "disturbance.h", "elementary.h", "events.h", "model_state.h", "philox.h", "sampled.h", "seed.h",
    "simulation.h",
)  # fmt: skip


@dataclass(frozen=True)
class Signal:
    """A variable of a plant: its `name`, unit, value at the start, `min`, `max`, `description`.

    `start` is a state's initial value, an input's or parameter's default, a disturbance's mean;
    outputs have none. `range` is a disturbance's half width (uniform) or standard deviation.
    """

    name: str
    unit: str
    start: float
    min: float
    max: float
    description: str
    range: float = 0.0


def plant_model(
    name: str,
    *,
    states: Sequence[Signal],
    inputs: Sequence[Signal],
    disturbances: Sequence[Signal],
    outputs: Sequence[Signal],
    parameters: Sequence[Signal] = (),
    sampling_time: float,
    description: str = "",
) -> Model:
    """The table of an FMU from the signals of a plant.

    Each state x has a derivative ``der(x)`` (in C ``VR_der_x``) and a start parameter ``x_start``,
    each disturbance d a mean ``d_nominal`` and a ``d_range``; beside them are the switches
    ``stochastic``, ``law`` (1 uniform, 2 normal; FMI 2.0 has an integer ``law_number``, too),
    ``seed``, ``seedHigh`` (FMI 2.0), ``sampling_time`` [s], whose multiples are when the
    disturbances are drawn anew, and ``saturate``, with which an input beyond its range acts at the
    bound.
    """
    drawn = ["stochastic", "law", "law_number", "seed", "seedHigh", "sampling_time", "time"]
    known = tuple(s.name for s in (*states, *inputs, *disturbances, *parameters))
    table = [Variable("time", Kind.INDEPENDENT, Type.REAL, "s", None, None, None, None, "time")]
    table += [_row(s, Kind.STATE, start=None, uses=(f"{s.name}_start",)) for s in states] + [
        _derivative(s, known) for s in states
    ]
    table += [_row(s, Kind.INPUT) for s in inputs]
    for d in disturbances:
        uses = (f"{d.name}_nominal", f"{d.name}_range", *drawn)
        table.append(_row(d, Kind.OUTPUT, start=None, uses=uses))
    table += [_row(s, Kind.OUTPUT, start=None, uses=known) for s in outputs]
    table += _switches(sampling_time)
    for d in disturbances:
        table.append(_row(d, Kind.TUNABLE, name=f"{d.name}_nominal", text=f"mean {d.description}"))
        table.append(
            Variable(
                f"{d.name}_range", Kind.TUNABLE, Type.REAL, d.unit, d.range, 0.0, d.max - d.min,
                _nominal(d.range), "half width (uniform) or standard deviation (normal)",
            )
        )  # fmt: skip
    table += [
        _row(s, Kind.FIXED, name=f"{s.name}_start", text=f"{s.name} at the start") for s in states
    ]
    table += [_row(s, Kind.TUNABLE) for s in parameters]
    units = dict.fromkeys(v.unit for v in table if v.unit)
    return Model(
        name=name,
        identifier=name,
        version="1.0.0",
        description=description,
        variables=tuple(table),
        units=tuple(Unit(u, exponents=(("s", 1),) if u == "s" else ()) for u in units),
        stop_time=100 * sampling_time,
        step_size=sampling_time,
        model_exchange=True,
    )


def build_plant(
    model: Model,
    equations: str | bytes,
    target: str | Path,
    version: FmiVersion = 2,
    every_platform: bool = False,
) -> Path:
    """Compile a plant's equations into the FMU `target`, with everything that a good FMU offers.

    `equations` is a C header that includes ``variables.h`` and defines ``static void
    evaluate(double v[N_VARIABLES])``: from the states, inputs, disturbances and parameters in `v`,
    each at its value reference ``VR_name``, it sets the outputs and the states' derivatives per
    second. FMI 2.0 or 3.0, co-simulation and model exchange; snapshots and their serialisation;
    draws that are a function of seed and sample; fourth-order Runge–Kutta steps of at most 1 s.
    Raises BuildError where there is no compiler or it complains.
    """
    own = {name: (SOURCES / name).read_bytes() for name in _SHARED}
    own |= {path.name: path.read_bytes() for path in sorted(PLANT_SOURCES.glob("*.h"))}
    own["equations.h"] = equations.encode() if isinstance(equations, str) else equations
    own["states.h"] = _states_header(model).encode()
    return assemble(
        model,
        version,
        sources_of(model, version, own),
        target,
        remarks=f"Disturbances are drawn every sampling_time, {model.step_size:g} s if not set.",
        every_platform=every_platform,
    )


def _nominal(value: float) -> float:
    return abs(value) or 1.0


def _row(
    signal: Signal,
    kind: Kind,
    *,
    name: str | None = None,
    start: float | bool | None = True,
    uses: tuple[str, ...] = (),
    text: str | None = None,
) -> Variable:
    return Variable(
        name or signal.name, kind, Type.REAL, signal.unit,
        signal.start if start is True else None, signal.min, signal.max,
        _nominal(signal.start), signal.description if text is None else text, uses,
    )  # fmt: skip


def _derivative(state: Signal, uses: tuple[str, ...]) -> Variable:
    return Variable(
        f"der({state.name})", Kind.DERIVATIVE, Type.REAL, f"{state.unit}/s", None, -1e6, 1e6,
        _nominal(state.start), f"time derivative of {state.name}", uses,
    )  # fmt: skip


def _switches(sampling_time: float) -> list[Variable]:
    fixed = Kind.FIXED
    return [
        Variable("stochastic", Kind.TUNABLE, Type.BOOLEAN, "", 1.0, 0.0, 1.0, None,
                 "draw the disturbances; false: their means"),
        Variable("law", fixed, Type.LAW, "", 1.0, 1.0, 2.0, None, "law of the disturbances"),
        Variable("seed", fixed, Type.SEED, "", 0.0, None, None, None, "seed of the disturbances"),
        Variable("seedHigh", fixed, Type.SEED_HIGH, "", 0.0, None, None, None,
                 "upper 32 bits of the seed (FMI 2.0 Integers have 32)"),
        Variable("sampling_time", fixed, Type.REAL, "s", sampling_time, 0.01, 86400.0,
                 sampling_time, "the disturbances are redrawn at its multiples and held between"),
        Variable("saturate", fixed, Type.BOOLEAN, "", 0.0, 0.0, 1.0, None, SATURATE),
        Variable("law_number", fixed, Type.LAW_NUMBER, "", 0.0, 0.0, 2.0, None, LAW_NUMBER),
    ]  # fmt: skip


def _states_header(model: Model) -> str:
    """The value references that the shared sources go through."""
    states = [model.by_name[name].identifier for name in model.names(Kind.STATE)]
    drawn = [n.removesuffix("_nominal") for n in model.by_name if n.endswith("_nominal")]
    rows = "".join(f"    {{VR_{d}, VR_{d}_nominal, VR_{d}_range}},\n" for d in drawn)

    def references(pattern: str) -> str:
        return ", ".join(pattern.format(state) for state in states)

    return f"""\
/* Generated from the table of {model.name}; do not edit. */
#ifndef STATES_H
#define STATES_H

#include "variables.h"

enum {{ N_STATES = {len(states)}, N_DISTURBANCES = {len(drawn)} }};

static const unsigned STATE_REFERENCES[N_STATES] = {{{references("VR_{}")}}};
static const unsigned DERIVATIVE_REFERENCES[N_STATES] = {{{references("VR_der_{}")}}};
static const unsigned START_REFERENCES[N_STATES] = {{{references("VR_{}_start")}}};

/* The last row is none: C has no empty array. */
static const struct {{
    int realised, nominal, range;
}} DISTURBANCES[N_DISTURBANCES + 1] = {{
{rows}    {{0, 0, 0}},
}};

#endif
"""
