"""Times an RTI-NMPC's phases along a closed loop, beside what else could do the same.

The command line is where packages are put together, so this module may use plant, loop and
controllers at once.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec
from typing import Any

import numpy as np

from controllers import RtiNmpc, compile_functions
from cosim.cli.benchmark.figures import clock, figure
from cosim.cli.benchmark.references import Q_SAMPLE, SAMPLE, Visit, references, rti_controller
from cosim.cli.compose import build_plant
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds

PHASES = ("prepare", "feedback", "V and dV/dθ", "dπ/dθ", "Q and dQ/dθ")
DAQP, INTERPRETER, PROXQP = "DAQP", "interpreter", "ProxQP"
AT_MOST = {DAQP: 60.0, PROXQP: 250.0}
"""Bounds of a sample in µs."""
EXPLORATION = 3.0
WARM_UP, BLOCK = 20, 50
Seconds = dict[str, list[float]]


def measure(
    scenario: Scenario, steps: int, every: int, progress: Callable[[int], None]
) -> dict[str, Any]:
    """Time each phase of a sample in µs, and how many times as long its references take.

    One closed loop of `steps` samples; at each of its states the controller with DAQP and compiled
    functions, the same one interpreted, and the one with ProxQP take the same sample in turn.
    `V and dV/dθ` is the feedback with the value's gradient, `dπ/dθ` the Jacobian beyond that,
    `Q and dQ/dθ` the feedback with the applied, explored action and its gradient. On every
    `every`-th sample the same QP goes to qpsolvers cold, the nonlinear programme at the same state
    to IPOPT, started from the RTI's guess, and the transition to mpcrl, where that is installed.
    `progress` gets the number of samples done.
    """
    controllers = {
        DAQP: rti_controller(scenario, "daqp"),
        INTERPRETER: rti_controller(scenario, "daqp"),
        PROXQP: rti_controller(scenario, "proxqp"),
    }
    for name, controller in controllers.items():
        if name != INTERPRETER:
            compile_functions(controller)
    mode = controllers[DAQP].functions
    seconds, visits = _run(scenario, controllers, steps, progress)
    ours = seconds[DAQP]
    interpreted = controllers[INTERPRETER].functions != mode
    rows = [
        figure(
            f"DAQP: {phase}",
            ours[phase],
            INTERPRETER if interpreted else None,
            seconds[INTERPRETER][phase] if interpreted else (),
            at_most=AT_MOST[DAQP] if phase == SAMPLE else None,
        )
        for phase in ours
    ]
    rows += [
        figure(f"DAQP: {phase}", ours[phase], PROXQP, seconds[PROXQP][phase])
        for phase in ("prepare", "feedback")
    ]
    rows.append(figure(f"ProxQP: {SAMPLE}", seconds[PROXQP][SAMPLE], at_most=AT_MOST[PROXQP]))
    chosen = visits[::every]
    for phase, reference, times, solved in references(scenario, chosen):
        row = figure(f"DAQP: {phase}", ours[phase][::every], reference, times)
        rows.append(row | {"reference_solved_share": solved / len(chosen)})
    return {
        "scenario": scenario.name,
        "hessian": scenario.controller.hessian,
        "functions": mode,
        "steps": steps,
        "compared": len(chosen),
        "missing": [] if find_spec("mpcrl") else ["mpcrl: pip install 'rti-cosim[outsiders]'"],
        "rows": rows,
    }


def _run(
    scenario: Scenario,
    controllers: dict[str, RtiNmpc],
    steps: int,
    progress: Callable[[int], None],
) -> tuple[dict[str, Seconds], list[Visit]]:
    """Run the closed loop under the first controller; time its phases and those of the others.

    The others follow block by block: near in time, and each as warm as in a loop of its own.
    """
    names = (*PHASES, SAMPLE, Q_SAMPLE)
    seconds: dict[str, Seconds] = {c: {phase: [] for phase in names} for c in controllers}
    visits: list[Visit] = []
    (first, leader), *others = controllers.items()
    plant_seed, rng = spawn_seeds(0)
    box = scenario.action_lower, scenario.action_upper
    with build_plant(scenario) as plant:
        s, done = plant.reset(plant_seed), 0
        while done < WARM_UP + steps:
            count = min(BLOCK, WARM_UP + steps - done)
            noise = EXPLORATION * rng.standard_normal((count, box[0].size))
            states: list[np.ndarray] = []
            rows: dict[str, list[dict[str, float]]] = {name: [] for name in controllers}
            for e in noise:
                times, a = _sample(leader, s, e, *box)
                step = plant.step(a)
                rows[first].append(times)
                cost = step.stage_cost + step.penalty
                visits.append(Visit(leader.linearisation_point, s, a, cost, step.s))
                states.append(s)
                s = step.s
            for name, follower in others:
                rows[name] += [
                    _sample(follower, x, e, *box)[0] for x, e in zip(states, noise, strict=True)
                ]
            for name, samples in rows.items():
                for sample in samples:
                    for phase, value in sample.items():
                        seconds[name][phase].append(value)
            done += count
            progress(max(0, done - WARM_UP))
    kept = {c: {p: values[WARM_UP:] for p, values in own.items()} for c, own in seconds.items()}
    return kept, visits[WARM_UP:]


def _sample(
    controller: RtiNmpc, s: np.ndarray, e: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> tuple[dict[str, float], np.ndarray]:
    """Seconds of each phase of a sample, and its action, which `e` explores."""
    begin = clock()
    controller.prepare()
    prepared = clock()
    solution = controller.feedback(s)
    fed_back = clock()
    solution.value_gradient  # noqa: B018 (computed on first access)
    graded = clock()
    solution.policy_jacobian  # noqa: B018
    moved = clock()
    a: np.ndarray = np.clip(solution.action + e, lower, upper)
    explored = clock()
    controller.feedback(s, a).value_gradient  # noqa: B018
    end = clock()
    return {
        "prepare": prepared - begin,
        "feedback": fed_back - prepared,
        "V and dV/dθ": graded - prepared,
        "dπ/dθ": moved - graded,
        "Q and dQ/dθ": end - explored,
        SAMPLE: graded - begin,
        Q_SAMPLE: fed_back - begin + end - explored,
    }, a
