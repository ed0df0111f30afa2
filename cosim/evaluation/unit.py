"""The work unit: one controller on a seed or several, run wherever a worker is free."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from controllers import compile_functions
from cosim.errors import EvaluationError
from cosim.evaluation import reuse
from cosim.evaluation.provenance import EVALUATING
from cosim.evaluation.reuse import require_code, require_fmu
from cosim.kpis import displaced, indicators, settling_time
from cosim.protocols import Controller, functions_of
from cosim.scenario import Scenario
from cosim.simulation import simulate

Factory = Callable[[Scenario], Controller]


BLOCK = 100
"""Samples of a unit, at least: giving one out costs about as much as twenty of them."""
SETTLING = (None,)
"""The seeds of the settling run, which has no disturbances."""


@dataclass(frozen=True)
class RunUnit:
    """What a worker needs to know: a controller and the `seeds` of its runs.

    `session` tells evaluations apart, so that a worker keeps its controllers within one; `code`
    and `fmu` are the hashes of code and FMU that the evaluation was started with.
    """

    session: str
    controller: str
    factory: Factory
    scenario: Scenario
    seeds: tuple[int | None, ...]
    steps: int
    code: str
    fmu: str


@dataclass(frozen=True)
class UnitResult:
    """Indicators by name, a value for each seed, and what the clock said, in s and µs.

    `functions` says how the controller's were computed at the ends of the runs.
    """

    seeds: tuple[int | None, ...]
    indicators: dict[str, list[float]]
    timing: dict[str, list[float]]
    functions: tuple[str, ...] = ()


def run(unit: RunUnit) -> UnitResult:
    """Run a unit; the result depends on nothing but the unit, so any worker may do it.

    Raises EvaluationError if this worker has other code or another FMU than the evaluation was
    started with, and whatever plant and controller raise.
    """
    require_code(unit.code, EVALUATING, EvaluationError)
    require_fmu(unit.scenario, unit.fmu, EvaluationError)
    controller = reuse.controller(
        f"{unit.session} {unit.controller}", lambda: unit.factory(unit.scenario)
    )
    compile_functions(controller, len(unit.seeds) * unit.steps)
    found: dict[str, list[float]] = {}
    timing: dict[str, list[float]] = {}
    functions: dict[str, None] = {}
    for seed in unit.seeds:
        if seed is None:
            found["settling_time"] = [_settling_run(unit, controller)]
            continue
        begin = perf_counter()
        trajectory = simulate(
            reuse.plant(unit.scenario), controller, unit.steps, seed, residuals=False
        )
        clock = {"wall_time_s": perf_counter() - begin}
        for name, quantiles in trajectory.timing_summary().items():
            clock |= {f"{name}_{key}": value for key, value in quantiles.items()}
        for values, figures in ((found, indicators(trajectory)), (timing, clock)):
            for name, value in figures.items():
                values.setdefault(name, []).append(value)
        if (computed := functions_of(controller)) is not None:
            functions[computed] = None
    return UnitResult(unit.seeds, found, timing, tuple(functions))


def _settling_run(unit: RunUnit, controller: Controller) -> float:
    scenario = displaced(unit.scenario)
    if scenario is None:
        return float("nan")
    trajectory = simulate(reuse.plant(scenario), controller, unit.steps, 0, residuals=False)
    return settling_time(trajectory)


def as_document(result: UnitResult) -> dict[str, Any]:
    """A result as a JSON document."""
    return {
        "seeds": list(result.seeds),
        "indicators": result.indicators,
        "timing": result.timing,
        "functions": list(result.functions),
    }


def from_document(document: dict[str, Any]) -> UnitResult:
    """Read back what `as_document` gave; raises KeyError, TypeError or ValueError."""
    seeds = tuple(None if seed is None else int(seed) for seed in document["seeds"])
    if seeds != SETTLING and (None in seeds or not all(0 <= s < 1 << 64 for s in seeds if s)):
        raise ValueError("no seeds")

    def columns(name: str) -> dict[str, list[float]]:
        found = {str(key): [float(v) for v in values] for key, values in document[name].items()}
        if any(len(values) != len(seeds) for values in found.values()):
            raise ValueError("not a value for each seed")
        return found

    return UnitResult(
        seeds,
        columns("indicators"),
        columns("timing"),
        tuple(str(word) for word in document["functions"]),
    )
