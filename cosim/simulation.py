"""The closed loop: it knows a plant and a controller by their protocols, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from cosim.errors import CosimError
from cosim.protocols import (
    Block,
    Controller,
    Exploration,
    Plant,
    Recorder,
    Solution,
    controller_name,
    is_solver_failure,
)
from cosim.scenario import Scenario
from cosim.trajectory import FALLBACK, Signal, Trajectory, signal_names

Array = NDArray[np.float64]
BLOCK = 500


def spawn_seeds(seed: int) -> tuple[int, np.random.Generator]:
    """Return the plant's seed (64 bits) and the exploration's generator for a run's seed.

    `SeedSequence(seed).spawn(2)`: the first child's first 64-bit word seeds the plant, the second
    child the generator. So two controllers run with one seed meet the same disturbances and
    the same exploration noise (common random numbers).
    """
    if seed < 0:
        raise CosimError(f"seed must not be negative, not {seed}")
    plant, exploration = np.random.SeedSequence(seed).spawn(2)
    return int(plant.generate_state(1, np.uint64)[0]), np.random.default_rng(exploration)


def simulate(
    plant: Plant,
    controller: Controller,
    steps: int,
    seed: int,
    *,
    exploration: Exploration | None = None,
    recorder: Recorder | None = None,
    progress: Callable[[int], None] | None = None,
) -> Trajectory:
    """Run a controller on a plant for `steps` samples from the scenario's initial state.

    Each sample: `prepare`, then `feedback(s)`, then the plant steps under the action, which the
    actuators saturate to the scenario's action bounds. `exploration` may change the action;
    `recorder` gets the run block by block; `progress` the number of samples done.

    If the controller fails to solve (an exception whose class has `is_solver_failure`), the last
    applied action is applied again (at the first sample the scenario's reference action), the
    failure is counted, and the controller is reset. Every other error ends the run and is raised.
    """
    if steps < 1:
        raise CosimError(f"steps must be at least 1, not {steps}")
    run = _Run(plant, controller, steps, seed, exploration)
    if recorder is None:
        run.go(_no_record, progress)
        return run.trajectory()
    recorder.start(plant.scenario, controller, seed, steps, plant.units)
    try:
        run.go(recorder.record, progress)
    finally:
        recorder.close()
    return run.trajectory()


def _no_record(_: Block) -> None:
    return None


class _Run:
    """Preallocated columns of one run and the loop that fills them."""

    def __init__(
        self,
        plant: Plant,
        controller: Controller,
        steps: int,
        seed: int,
        exploration: Exploration | None,
    ) -> None:
        self._plant, self._controller = plant, controller
        self._scenario: Scenario = plant.scenario
        self._exploration = exploration
        self._seed, self._steps = seed, steps
        table = self._scenario.plant
        self._states = np.empty((steps, len(table.states)))
        self._actions = np.empty((steps, len(table.actions)))
        self._disturbances = np.empty((steps, len(table.disturbances)))
        self._stage_cost, self._penalty = np.empty(steps), np.empty(steps)
        self._value, self._residual = np.full(steps, np.nan), np.full(steps, np.nan)
        self._explored, self._failed = np.zeros(steps, bool), np.zeros(steps, bool)
        self._prepare_time, self._feedback_time = np.empty(steps), np.empty(steps)
        self._plant_time = np.empty(steps)
        self._status: list[str] = []
        self._time: Array = np.arange(steps, dtype=np.float64) * self._scenario.sampling_time
        self._predicted_states: Array | None = None
        self._predicted_actions: Array | None = None
        self._final_state: Array | None = None

    def go(self, record: Callable[[Block], None], progress: Callable[[int], None] | None) -> None:
        keeps_predictions = record is not _no_record
        shape, saturate = self._scenario.action_lower.shape, self._scenario.saturate
        plant_seed, rng = spawn_seeds(self._seed)
        s = self._plant.reset(plant_seed)
        self._controller.reset()
        applied = self._scenario.reference_action
        exploration = self._exploration
        for k in range(self._steps):
            solution = self._solve(k, s)
            action = applied if solution is None else solution.action
            if exploration is not None:
                explored = exploration(action, rng)
                # A failed sample draws its noise too, so that paired runs stay in step.
                if solution is not None and explored is not None:
                    self._explored[k] = True
                    action = explored
            if action.shape != shape:
                raise CosimError(
                    f"{controller_name(self._controller)} gave an action of shape {action.shape}, "
                    f"not {shape}, at step {k}"
                )
            applied = saturate(action)
            self._states[k] = s
            self._actions[k] = applied
            begin = perf_counter()
            s, self._stage_cost[k], self._penalty[k], self._disturbances[k] = self._plant.step(
                applied
            )
            self._plant_time[k] = perf_counter() - begin
            if keeps_predictions and solution is not None:
                self._keep_prediction(k % BLOCK, solution)
            if (k + 1) % BLOCK == 0 or k + 1 == self._steps:
                record(self._block(k // BLOCK * BLOCK, k + 1))
                if progress is not None:
                    progress(k + 1)
        self._final_state = s

    def _solve(self, k: int, s: Array) -> Solution | None:
        """Prepare and feed back, timed apart; None if the controller declares a failure."""
        controller = self._controller
        begin = middle = perf_counter()
        try:
            controller.prepare()
            middle = perf_counter()
            solution = controller.feedback(s)
        except Exception as error:
            if not is_solver_failure(error):
                raise
            end = perf_counter()
            self._status.append(FALLBACK)
            self._failed[k] = True
            controller.reset()
            self._prepare_time[k], self._feedback_time[k] = middle - begin, end - middle
            return None
        end = perf_counter()
        self._prepare_time[k], self._feedback_time[k] = middle - begin, end - middle
        self._status.append(solution.status)
        self._value[k], self._residual[k] = solution.value, solution.residual
        return solution

    def _keep_prediction(self, row: int, solution: Solution) -> None:
        states, actions = solution.predicted_states, solution.predicted_actions
        if states is None or actions is None:
            return
        if self._predicted_states is None or self._predicted_actions is None:
            self._predicted_states = np.full((BLOCK, *states.shape), np.nan)
            self._predicted_actions = np.full((BLOCK, *actions.shape), np.nan)
        self._predicted_states[row] = states
        self._predicted_actions[row] = actions

    def _block(self, first: int, end: int) -> Block:
        rows, count = slice(first, end), end - first
        states, actions = self._predicted_states, self._predicted_actions
        self._predicted_states = self._predicted_actions = None
        return Block(
            first=first,
            time=self._time[rows],
            states=self._states[rows],
            actions=self._actions[rows],
            disturbances=self._disturbances[rows],
            stage_cost=self._stage_cost[rows],
            penalty=self._penalty[rows],
            value=self._value[rows],
            residual=self._residual[rows],
            explored=self._explored[rows],
            failed=self._failed[rows],
            status=self._status[rows],
            prepare_time=self._prepare_time[rows],
            feedback_time=self._feedback_time[rows],
            predicted_states=None if states is None else states[:count],
            predicted_actions=None if actions is None else actions[:count],
        )

    def trajectory(self) -> Trajectory:
        scenario, table = self._scenario, self._scenario.plant
        cost_unit = self._plant.units[table.stage_cost]
        violation = scenario.state_penalty.violation(self._states)
        columns = [
            self._time,
            *self._states.T,
            *self._actions.T,
            *self._disturbances.T,
            self._stage_cost,
            self._penalty,
            violation.sum(axis=1),
            self._value,
            self._residual,
            self._explored.astype(float),
            self._failed.astype(float),
        ]
        units = {"time": "s", "stage_cost": cost_unit, "penalty": cost_unit, "value": cost_unit}
        units |= {name: self._plant.units[name] for name in scenario_variables(scenario)}
        return Trajectory(
            scenario=scenario,
            signals={
                name: Signal(name, units.get(name, ""), np.ascontiguousarray(column))
                for name, column in zip(signal_names(scenario), columns, strict=True)
            },
            status=self._status,
            timing={
                "prepare": self._prepare_time,
                "feedback": self._feedback_time,
                "plant": self._plant_time,
            },
            final_state=self._final_state,
            seed=self._seed,
            controller=controller_name(self._controller),
        )


def scenario_variables(scenario: Scenario) -> list[str]:
    """Names of states, actions and disturbances."""
    plant = scenario.plant
    return [*plant.states, *plant.actions, *plant.disturbances]
