"""An extended Kalman filter as C: CasADi's code for its model, and the filter's constants."""

from __future__ import annotations

import numpy as np

from controllers.errors import ControllerError
from controllers.export.core import (
    ENGINE_SOURCES,
    Observer,
    array_text,
    filled,
    static_functions,
)
from controllers.filter_model import FilterModel, by_direction
from controllers.functions import not_in_c, work_sizes
from cosim.core.protocols import Vector


def estimated_state(
    model: FilterModel,
    variances: Vector,
    *,
    in_theta: bool,
    most_margins: Vector | None = None,
) -> Observer:
    """The state of an exported controller as a filter estimates it.

    Args:
        model: What the filter computes with.
        variances: Of its disturbances, drifts and sensors, (q,).
        in_theta: Whether θ has them, in the block `noise`.
        most_margins: Most that each state's bounds are tightened by, (n,); None where θ has no
            block `margin`.

    Raises:
        ControllerError: The model calls what cannot be C.
    """
    reason = not_in_c([model.transition.function, model.output.function])
    if reason is not None:
        raise ControllerError(
            f"the estimator cannot be exported: {reason}; write the model as expressions or as a "
            "table (casadi.interpolant)"
        )
    n_all = model.n_kept * model.start.size
    return Observer(
        rule="state_estimated.h",
        sources=filter_sources(
            model,
            variances=variances,
            in_theta=in_theta,
            most_margins=most_margins,
        ),
        # Before a sample's readings and behind them.
        memory=2 * (model.n_noises + max(len(model.signals), 1) + n_all + n_all**2),
        readings=model.variables,
        estimates=model.start.size,
    )


def filter_sources(
    model: FilterModel,
    *,
    differentiates: bool = False,
    variances: Vector | None = None,
    in_theta: bool = False,
    most_margins: Vector | None = None,
) -> dict[str, bytes]:
    """C files of a filter; `filter.h` is what to include.

    Args:
        model: What it computes with.
        differentiates: Whether its derivatives by its variances are among them.
        variances: Those that it starts with, (q,); None where another says them.
        in_theta: Whether θ says them at each sample.
        most_margins: As `estimated_state` takes them.

    Returns:
        Contents by file name, the same bytes for the same model.
    """
    definitions = {"TRANSITION": model.transition, "OUTPUT": model.output}
    if differentiates:
        definitions["TRANSITION_BY_Z"] = by_direction(model.transition)
        definitions["OUTPUT_BY_Z"] = by_direction(model.output)
    sizes = {
        "FILTER_Z": model.start.size,
        "FILTER_U": model.transition.inputs["u"],
        "FILTER_D": model.n_disturbances,
        "FILTER_DRIFTS": model.n_drifts,
        "FILTER_Y": len(model.delays),
        "FILTER_KEPT": model.n_kept,
        "FILTER_NOISES": model.n_noises,
        "FILTER_SIGNALS": len(model.signals),
        # C has no array of no entry.
        "FILTER_SIGMA": max(len(model.signals), 1),
    }
    for prefix, definition in definitions.items():
        sizes |= work_sizes(prefix, definition.function)
    for prefix in ("TRANSITION", "OUTPUT"):
        start = 0
        for name, (rows, columns) in definitions[prefix].shapes.items():
            sizes[f"{prefix}_{name}"] = start
            start += rows * columns
        sizes[f"{prefix}_SIZE"] = start
    nominal = [item.nominal for _, item in model.signals]
    signal_rows = [row for row, _ in model.signals]
    arrays = {
        "FILTER_START": model.start,
        "FILTER_START_DEVIATION": model.start_deviation,
        "FILTER_NOMINAL": np.array(nominal or [0.0]),
    }
    if variances is not None:
        arrays["FILTER_VARIANCES"] = variances
    if most_margins is not None:
        arrays["FILTER_MOST_MARGIN"] = most_margins
    functions = [definition.function for definition in definitions.values()]
    header = filled(
        "filter_model.h.in",
        sizes="\n".join(f"    {name} = {value}," for name, value in sizes.items()),
        delays=", ".join(map(str, model.delays)),
        arrays="\n".join(array_text(name, values) for name, values in arrays.items()),
        rows=", ".join(map(str, signal_rows or [0])),
        in_theta=str(int(in_theta)),
        margin=str(int(most_margins is not None)),
        functions=static_functions("filter", functions).decode(),
    )
    sources = {"filter_model.h": header.encode()}
    names = ["filter.h"]
    if differentiates:
        names.append("filter_sensitivities.h")
    for name in names:
        sources[name] = (ENGINE_SOURCES / name).read_bytes()
    return sources
