"""The work unit: one controller on one seed, run wherever a worker is free."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from cosim.errors import EvaluationError
from cosim.evaluation import reuse
from cosim.evaluation.provenance import EVALUATING
from cosim.evaluation.reuse import require_code, require_fmu
from cosim.kpis import displaced, indicators, settling_time
from cosim.protocols import Controller, functions_of
from cosim.scenario import Scenario
from cosim.simulation import simulate

Factory = Callable[[Scenario], Controller]


@dataclass(frozen=True)
class RunUnit:
    """What a worker needs to know; `seed` None is the settling run without disturbances.

    `session` tells evaluations apart, so that a worker keeps its controllers within one; `code`
    and `fmu` are the hashes of code and FMU that the evaluation was started with.
    """

    session: str
    controller: str
    factory: Factory
    scenario: Scenario
    seed: int | None
    steps: int
    code: str
    fmu: str


@dataclass(frozen=True)
class UnitResult:
    """Indicators of a unit, and what the clock said: `timing` in s and µs, never in the table.

    `functions` says how the controller's were computed at its end, None where it has none.
    """

    indicators: dict[str, float]
    timing: dict[str, float]
    functions: str | None = None


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
    if unit.seed is None:
        return _settling_run(unit, controller)
    begin = perf_counter()
    trajectory = simulate(
        reuse.plant(unit.scenario), controller, unit.steps, unit.seed, residuals=False
    )
    timing = {"wall_time_s": perf_counter() - begin}
    for name, quantiles in trajectory.timing_summary().items():
        timing |= {f"{name}_{key}": value for key, value in quantiles.items()}
    return UnitResult(indicators(trajectory), timing, functions_of(controller))


def _settling_run(unit: RunUnit, controller: Controller) -> UnitResult:
    scenario = displaced(unit.scenario)
    if scenario is None:
        return UnitResult({"settling_time": float("nan")}, {})
    trajectory = simulate(reuse.plant(scenario), controller, unit.steps, 0, residuals=False)
    return UnitResult({"settling_time": settling_time(trajectory)}, {})


def as_document(result: UnitResult) -> dict[str, Any]:
    """A result as a JSON document."""
    return {
        "indicators": result.indicators,
        "timing": result.timing,
        "functions": result.functions,
    }


def from_document(document: dict[str, Any]) -> UnitResult:
    """Read back what `as_document` gave; raises KeyError, TypeError or ValueError."""
    return UnitResult(
        {str(key): float(value) for key, value in document["indicators"].items()},
        {str(key): float(value) for key, value in document["timing"].items()},
        document.get("functions"),
    )
