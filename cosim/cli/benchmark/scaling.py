"""How the cost of a sample grows with horizon and θ, interpreted and compiled, in CPU time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from controllers import Parameters, Problem, RtiNmpc, ThetaBlocks, compile_functions
from cosim.cli.benchmark.figures import clock
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds

SAMPLES, REPETITIONS = 20, 5
MODEL_PARAMETERS = ("UA2", "h")
PHASES = ("prepare", "feedback", "dV/dθ", "dπ/dθ")


def measure(
    scenario: Scenario, horizons: Sequence[int], progress: Callable[[int], None]
) -> dict[str, Any]:
    """Time the phases of a sample for each horizon, and at the scenario's own for larger θ.

    Every row is a controller on one walk of the state, first interpreted, then compiled where there
    is a compiler: CPU time in µs per sample, the least of `REPETITIONS` means over `SAMPLES`
    samples; `construction_s` in s. `ratios` are interpreter's over compiled time, by phase.
    """
    cases = [(horizon, "paper") for horizon in horizons]
    cases += [(scenario.controller.horizon, kind) for kind in ("slack weights", "model parameters")]
    rows = []
    for done, (horizon, kind) in enumerate(cases, start=1):
        rows.append(_row(scenario, horizon, kind))
        progress(done)
    return {"scenario": scenario.name, "hessian": scenario.controller.hessian, "rows": rows}


def _row(scenario: Scenario, horizon: int, kind: str) -> dict[str, Any]:
    problem = Problem.from_scenario(scenario.replace({"controller": {"horizon": horizon}}))
    blocks = ThetaBlocks.of(
        problem,
        slack_weights=kind == "slack weights",
        model_parameters=MODEL_PARAMETERS if kind == "model parameters" else (),
    )
    begin = clock()
    controller = RtiNmpc(
        problem, Parameters.naive(problem, blocks), hessian=scenario.controller.hessian
    )
    construction = clock() - begin
    microseconds = {controller.functions: _phases(controller)}
    compile_functions(controller)
    mode = controller.functions
    microseconds[mode] = _phases(controller)
    first, last = next(iter(microseconds.values())), microseconds[mode]
    return {
        "horizon": horizon,
        "theta": kind,
        "n_theta": blocks.size,
        "construction_s": construction,
        "microseconds": microseconds,
        "ratios": {phase: first[phase] / last[phase] for phase in PHASES},
    }


def _phases(controller: RtiNmpc) -> dict[str, float]:
    """Least mean CPU time of each phase, in µs."""
    means = [_walk(controller) for _ in range(REPETITIONS)]
    return {phase: 1e6 * min(mean[phase] for mean in means) for phase in PHASES}


def _walk(controller: RtiNmpc) -> dict[str, float]:
    spent = dict.fromkeys(PHASES, 0.0)
    controller.reset()
    for s in _states(controller.problem):
        read = [clock()]
        controller.prepare()
        read.append(clock())
        solution = controller.feedback(s)
        read.append(clock())
        solution.value_gradient  # noqa: B018 (computed on first access)
        read.append(clock())
        solution.policy_jacobian  # noqa: B018
        read.append(clock())
        for phase, seconds in zip(PHASES, np.diff(read), strict=True):
            spent[phase] += float(seconds) / SAMPLES
    return spent


def _states(problem: Problem) -> Iterator[np.ndarray]:
    _, rng = spawn_seeds(0)
    spread = 0.02 * np.abs(problem.reference_state)
    for _ in range(SAMPLES):
        yield problem.reference_state + spread * rng.standard_normal(problem.n_states)
