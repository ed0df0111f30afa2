"""A plant from a model: its equations in CasADi become the C of an FMU.

So a plant is written once. The controller may use the same model, with other parameters or another
one; the FMU has noise, snapshots and both interfaces of FMI from `fmus.plant`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import inf, isfinite
from pathlib import Path

import casadi as ca

from controllers.errors import ModelError
from controllers.functions import c_source, not_in_c
from controllers.model import Model, Quantity
from cosim.core.validation import instead
from fmus.model import FmiVersion
from fmus.plant import Signal, plant_model
from fmus.plant import build_plant as build_from_c

COST_OUTPUT = "cost"
"""Output of the FMU that is the stage cost."""
EQUATIONS = "plant_equations"
"""C function of the rates and outputs."""


def build_plant(
    model: Model,
    target: str | Path,
    *,
    sampling_time: float,
    limits: Mapping[str, tuple[float, float]],
    ranges: Mapping[str, float] | None = None,
    time_constants: Mapping[str, float] | None = None,
    values: Mapping[str, float] | None = None,
    units: Mapping[str, str] | None = None,
    description: str = "",
    version: FmiVersion = 2,
    every_platform: bool = False,
) -> Path:
    """Build the FMU of a plant from its model, for co-simulation and model exchange.

    Its variables have the names and units of the model's quantities. Its outputs are `cost`, the
    economic cost, and the model's `outputs`. Disturbances are drawn anew in each sample, or
    filtered, as in `fmus.plant.plant_model`.

    Args:
        model: The plant's equations.
        target: Path of the FMU.
        sampling_time: In s; disturbances are drawn at its multiples.
        limits: Least and greatest value by name: of each action, and of others if known.
        ranges: Of disturbances by name: half width (uniform law) or standard deviation (normal);
            0 where not given.
        time_constants: Of the filter of disturbances' draws by name, in s; 0 where not given.
        values: What the plant has in place of the model's nominal values, by name: states at the
            start, actions by default, means of disturbances, parameters.
        units: Of `cost` and of the model's outputs, by name; "1" where not given.
        description: Of the plant, for the model description.
        version: Major version of FMI, 2 or 3.
        every_platform: Build for each of `fmus.PLATFORMS`, not for the platform at hand alone.

    Returns:
        The path of the FMU.

    Raises:
        ModelError: The model cannot be C by itself, or a name or number does not fit it.
        BuildError: There is no compiler, or it refuses the equations.
    """
    ranges = dict(ranges or {})
    time_constants = dict(time_constants or {})
    values = dict(values or {})
    units = dict(units or {})
    disturbances = _names_of(model.disturbances)
    known = [*_names_of(model.states), *_names_of(model.actions), *disturbances]
    known += _names_of(model.parameters)
    computed = [COST_OUTPUT, *model.outputs]
    _check_known(model, "limits", limits, [*known, *computed])
    _check_known(model, "ranges", ranges, disturbances)
    _check_known(model, "time_constants", time_constants, disturbances)
    _check_known(model, "values", values, known)
    _check_known(model, "units", units, computed)
    _check_numbers(model, "ranges", ranges, 0.0)
    _check_numbers(model, "time_constants", time_constants, 0.0)
    _check_numbers(model, "values", values, -inf)
    if not (isfinite(sampling_time) and sampling_time > 0):
        raise ModelError(
            f"model '{model.name}': sampling_time must be positive seconds, not {sampling_time!r}"
        )
    for quantity in model.actions:
        low, high = limits.get(quantity.name, (-inf, inf))
        if not (isfinite(low) and isfinite(high)):
            raise ModelError(
                f"model '{model.name}': limits must have the range of action {quantity.name}, "
                "two finite numbers"
            )

    def signal(quantity: Quantity) -> Signal:
        """A quantity as a variable of the plant."""
        name = quantity.name
        low, high = limits.get(name, (-inf, inf))
        start = float(values.get(name, quantity.nominal))
        if not low <= start <= high:
            raise ModelError(
                f"model '{model.name}': {name} is {start:g} at the start, which is not between its "
                f"limits {low:g} and {high:g}"
            )
        return Signal(
            name,
            quantity.unit,
            start=start,
            min=low,
            max=high,
            description=name,
            range=float(ranges.get(name, 0.0)),
            time_constant=float(time_constants.get(name, 0.0)),
        )

    outputs = []
    for name in computed:
        low, high = limits.get(name, (-inf, inf))
        outputs.append(Signal(name, units.get(name, "1"), min=low, max=high, description=name))
    table = plant_model(
        model.name,
        states=[signal(quantity) for quantity in model.states],
        inputs=[signal(quantity) for quantity in model.actions],
        disturbances=[signal(quantity) for quantity in model.disturbances],
        outputs=outputs,
        parameters=[signal(quantity) for quantity in model.parameters],
        sampling_time=sampling_time,
        description=description,
    )
    _check_identifiers(model, [variable.identifier for variable in table.variables])
    return build_from_c(table, equations_in_c(model), target, version, every_platform)


def equations_in_c(model: Model) -> str:
    """C header of a model's equations, as `fmus.plant.build_plant` takes it.

    Args:
        model: The plant's equations.

    Raises:
        ModelError: The model cannot be C by itself.
    """
    x, u, d, p = model.symbols()
    # The FMU's rates are per second.
    rates = model.ode(x, u, d, p) / model.time_unit
    outputs = [model.economic_cost(x, u, d, p)]
    for output in model.outputs.values():
        outputs.append(output(x, u, d, p))
    function = ca.Function(
        EQUATIONS,
        [x, u, d, p],
        [ca.densify(rates), ca.densify(ca.vertcat(*outputs))],
        {"cse": True},
    )
    reason = not_in_c([function])
    if reason is not None:
        raise ModelError(f"model '{model.name}': {reason}, which cannot be written as C")
    lines = []
    groups = (model.states, model.actions, model.disturbances, model.parameters)
    for letter, quantities in zip("xudp", groups, strict=True):
        places = [f"v[VR_{quantity.name}]" for quantity in quantities]
        # C has no empty array.
        lines.append(f"const double {letter}[] = {{{', '.join(places) or '0.0'}}};")
    lines += [
        f"double rates[{len(model.states)}], outputs[{len(outputs)}];",
        f"const double *arguments[{function.sz_arg()}] = {{x, u, d, p}};",
        f"double *results[{function.sz_res()}] = {{rates, outputs}};",
        f"long long iw[{function.sz_iw() + 1}];",
        f"double w[{function.sz_w() + 1}];",
        f"{EQUATIONS}(arguments, results, iw, w, 0);",
    ]
    for i, quantity in enumerate(model.states):
        lines.append(f"v[VR_der_{quantity.name}] = rates[{i}];")
    for i, name in enumerate((COST_OUTPUT, *model.outputs)):
        lines.append(f"v[VR_{name}] = outputs[{i}];")
    body = "\n".join(f"    {line}" for line in lines)
    return f"""/* Generated from the model {model.name}; do not edit. */
#ifndef EQUATIONS_H
#define EQUATIONS_H
#include "variables.h"

#define CASADI_SYMBOL_EXPORT static
{c_source([function], "equations")}

static void evaluate(double v[N_VARIABLES]) {{
{body}
}}
#endif
"""


def _names_of(quantities: Iterable[Quantity]) -> list[str]:
    return [quantity.name for quantity in quantities]


def _check_known(
    model: Model,
    argument: str,
    names: Iterable[str],
    known: list[str],
) -> None:
    """Refuse a name that is not known."""
    for name in names:
        if name not in known:
            raise ModelError(f"model '{model.name}': {argument} has '{name}'{instead(name, known)}")


def _check_numbers(
    model: Model,
    argument: str,
    values: Mapping[str, float],
    least: float,
) -> None:
    """Refuse what is no finite number, or below the least one."""
    for name, value in values.items():
        if not isfinite(value) or value < least:
            sign = " of at least 0" if least == 0 else ""
            raise ModelError(
                f"model '{model.name}': {argument} of {name} must be a finite number{sign}, not "
                f"{value!r}"
            )


def _check_identifiers(model: Model, identifiers: list[str]) -> None:
    """Refuse names that C does not know apart, or that the FMU needs for itself."""
    for quantities in (model.states, model.actions, model.disturbances, model.parameters):
        for name in [model.name, *_names_of(quantities), *model.outputs]:
            if not name.isidentifier() or not name.isascii():
                raise ModelError(
                    f"model '{model.name}': '{name}' is no name in C: letters, digits and _"
                )
    doubled = sorted({name for name in identifiers if identifiers.count(name) > 1})
    if doubled:
        raise ModelError(
            f"model '{model.name}': {', '.join(doubled)} is twice in the FMU, which "
            "needs such a name for itself: rename the quantity"
        )
