"""An extended Kalman filter as C: CasADi's code for its model, and the filter's constants."""

from __future__ import annotations

from controllers.export.core import ENGINE_SOURCES, array_text, filled, static_functions
from controllers.filter_model import FilterModel, by_direction
from controllers.functions import work_sizes


def filter_sources(model: FilterModel, *, differentiates: bool) -> dict[str, bytes]:
    """C files of a filter; `filter.h` is what to include.

    Args:
        model: What it computes with.
        differentiates: Whether its derivatives by its variances are among them.

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
    }
    for prefix, definition in definitions.items():
        sizes |= work_sizes(prefix, definition.function)
    for prefix in ("TRANSITION", "OUTPUT"):
        start = 0
        for name, (rows, columns) in definitions[prefix].shapes.items():
            sizes[f"{prefix}_{name}"] = start
            start += rows * columns
        sizes[f"{prefix}_SIZE"] = start
    arrays = {"FILTER_START": model.start, "FILTER_START_DEVIATION": model.start_deviation}
    functions = [definition.function for definition in definitions.values()]
    header = filled(
        "filter_model.h.in",
        sizes="\n".join(f"    {name} = {value}," for name, value in sizes.items()),
        delays=", ".join(map(str, model.delays)),
        arrays="\n".join(array_text(name, values) for name, values in arrays.items()),
        functions=static_functions("filter", functions).decode(),
    )
    sources = {"filter_model.h": header.encode()}
    names = ["filter.h"]
    if differentiates:
        names.append("filter_sensitivities.h")
    for name in names:
        sources[name] = (ENGINE_SOURCES / name).read_bytes()
    return sources
