"""The optimal policy of a scenario whose prices are periodic: the yardstick of regret there.

It knows the whole period: under a preview that is shorter, or none, J* is a bound from below.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.dynamic_programming import BellmanOperator, Grid, Settings
from controllers.dynamic_programming.periodic import (
    PeriodicOptimum,
    PeriodicPlant,
    StepProgress,
    solve_periodic,
)
from controllers.errors import ModelError, OptimumError
from controllers.model import Model
from controllers.optimum import (
    PolicyTable,
    change_of,
    look_up,
    optimum_key,
    read_solution,
    solution_document,
    solution_fields,
    stored_file,
    write_solution,
)
from controllers.problem import PlantProblem, is_price
from cosim.core.files import cache_folder
from cosim.core.protocols import Array, Decision
from cosim.core.scenario import Scenario, SignalTable
from cosim.core.signals import Signals, period_of
from cosim.core.validation import instead

PERIODIC_VERSION = 1
"""Part of every key; to be raised when the solver's results change."""
ACTION_STEPS = 4096
"""Steps of an actuator's range to which stored actions are rounded."""
VALUE_STEP = 1e-3
"""Share of the gain to which stored values are rounded."""
LONGEST_PERIOD = 10_080
"""Most samples of a period: each has a policy of its own."""


def periodic_plant(scenario: Scenario) -> PeriodicPlant:
    """The plant of a scenario with signals, at each phase of their period.

    Args:
        scenario: with signals.

    Raises:
        OptimumError: a signal is no price of the plant's model, or has no period, or the plant is
            none that has an optimum.
        ModelError: a signal names what the model does not have.
    """
    where = f"scenario '{scenario.name}'"
    if change_of(scenario.still) is not None:
        raise OptimumError(f"{where} has signals and a plant that changes: no J* is computed")
    for table in scenario.signals or ():
        _require_price(table, where)
    period = period_of(scenario)
    if period is None:
        raise OptimumError(f"{where}: J* needs signals with a period of whole samples")
    if period > LONGEST_PERIOD:
        raise OptimumError(
            f"{where}: its signals begin again after {period} samples, and J* is computed for at "
            f"most {LONGEST_PERIOD}"
        )
    plant = PlantProblem.from_scenario(scenario.still)
    if plant.memory is not None:
        raise OptimumError(f"{where} has signals and a disturbance with a memory: no J* of both")
    signals = Signals(scenario)
    parameters = np.tile(plant.parameters, (period, 1))
    for i, table in enumerate(signals.tables):
        index = _price_index(table, plant.problem.model)
        parameters[:, index] = [signals.value(i, k) for k in range(period)]
    return PeriodicPlant(plant, parameters)


def _require_price(table: SignalTable, where: str) -> None:
    """Raise OptimumError where a signal is no price of what the plant's model knows."""
    signal = f"{where}: signal '{table.name}'"
    if table.measures is not None:
        raise OptimumError(f"{signal} is a measured disturbance, which has no period: no J* of it")
    if table.price_of is None or table.model is None or table.plant is not None:
        raise OptimumError(
            f"{signal} is no price (price_of and model): J* is computed where prices alone move"
        )


def _price_index(table: SignalTable, model: Model) -> int:
    """Which parameter of the plant's model a price is; raises ModelError, OptimumError."""
    names = [quantity.name for quantity in model.parameters]
    name = str(table.model)
    if name not in names:
        raise ModelError(
            f"signal '{table.name}': model '{model.name}' of the plant has no parameter '{name}'"
            f"{instead(name, names)}"
        )
    index = names.index(name)
    if not is_price(model, index):
        raise OptimumError(
            f"signal '{table.name}': parameter '{name}' is in the dynamics of model "
            f"'{model.name}', or not in its cost: J* is computed where prices alone move"
        )
    # Else the cost of model and plant would differ by a constant price.
    nominal = model.nominal_parameters[index]
    if nominal != table.included:
        raise OptimumError(
            f"signal '{table.name}': included = {table.included:g}, and '{name}' of model "
            f"'{model.name}' is {nominal:g} without the signal: both are the price in the FMU's "
            "cost, so they must be equal"
        )
    return index


# stored solutions -----------------------------------------------------------------------------


def periodic_key(periodic: PeriodicPlant, settings: Settings) -> str:
    """First 16 hexadecimal digits of the SHA-256 of all that the solution depends on.

    Args:
        periodic: The plant.
        settings: The solver's settings.
    """
    still = optimum_key(periodic.plant, settings)
    content = {
        "version": PERIODIC_VERSION,
        "still": still,
        "parameters": periodic.parameters.tolist(),
    }
    text = json.dumps(content, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def keep_periodic(key: str, periodic: PeriodicPlant, optimum: PeriodicOptimum) -> Path:
    """Keep a solution in the user's cache, rounded: a policy for each phase would be large.

    Actions are multiples of a 4096th of the actuators' range, values of a thousandth of the gain;
    from phase to phase few of them differ.

    Args:
        key: Its `periodic_key`.
        periodic: The plant.
        optimum: The solution.

    Returns:
        The file.
    """
    problem = periodic.plant.problem
    action_step = (problem.action_upper - problem.action_lower) / ACTION_STEPS
    value_step = abs(optimum.gain) * VALUE_STEP or 1.0
    document = {
        **solution_document(optimum, key),
        "action_step": action_step.tolist(),
        "value_step": value_step,
    }
    arrays = {
        "action_changes": _changes(optimum.actions / action_step),
        "value_changes": _changes(optimum.W / value_step),
    }
    return write_solution(cache_folder("optima") / f"{key}.npz", optimum.grid, arrays, document)


def _changes(values: Array) -> NDArray[np.int32]:
    """Values (P, …), rounded to whole numbers, as changes from phase to phase."""
    whole = np.rint(values).astype(np.int64)
    return np.diff(whole, axis=0, prepend=0).astype(np.int32)


def _along(changes: NDArray[np.int32]) -> Array:
    """Whole numbers of which these are the changes from phase to phase, (P, …)."""
    return np.cumsum(changes, axis=0, dtype=np.int64).astype(np.float64)


def read_periodic(path: Path, key: str) -> PeriodicOptimum:
    """Read a stored solution.

    Args:
        path: The file.
        key: The `periodic_key` of the problem that it must hold.

    Raises:
        OptimumError: The file is damaged, or another problem's.
    """
    return read_solution(path, key, _periodic_optimum_of)


def _periodic_optimum_of(
    arrays: Mapping[str, Any],
    document: Mapping[str, Any],
) -> PeriodicOptimum:
    """The solution in a file's arrays and document."""
    return PeriodicOptimum(
        actions=_along(arrays["action_changes"]) * np.array(document["action_step"]),
        W=_along(arrays["value_changes"]) * float(document["value_step"]),
        **solution_fields(arrays, document),
    )


def periodic_is_stored(scenario: Scenario) -> bool:
    """Whether the solution of a scenario with signals is shipped or cached."""
    try:
        periodic = periodic_plant(scenario)
    except (ModelError, OptimumError):
        return False
    return stored_file(periodic_key(periodic, Settings())) is not None


def expected_seconds(periodic: PeriodicPlant, *, refine: bool = False) -> float:
    """Seconds that a solution takes on this machine as it is, to within a factor of two or so.

    A product of the Bellman operator is timed; the work is a known number of these, and of phases.

    Args:
        periodic: The plant.
        refine: Whether it is certified, too.
    """
    settings = Settings()
    operator = BellmanOperator(periodic.plant, settings.accuracy(periodic.plant), workers=2)
    problem = periodic.plant.problem
    count = 200
    states = np.tile(problem.reference_state, (count, 1))
    actions = np.tile(problem.reference_action, (count, 1))
    axes = [np.linspace(x - 1.0, x + 1.0, 9) for x in problem.reference_state]
    grid = Grid(tuple(axes))
    # The first call loads what it needs.
    operator.transitions(states[:1], actions[:1], grid)
    begin = perf_counter()
    operator.transitions(states, actions, grid)
    per_state = (perf_counter() - begin) / count
    # Counted on `prices`, in states: some 1500 of the grid, and five periods.
    work = 1500 * 140 + 80 * periodic.period
    if refine:
        # A grid of three times as many states, three periods on it, and the simulation.
        work += 1500 * 210 + 240 * periodic.period
    return per_state * work


# the policy -----------------------------------------------------------------------------------


class PeriodicPolicy:
    """π*(s) and V*(s) of the phase that the time is in, from a solved grid.

    It knows the period and the time, which `reset` sets to 0 and `prepare` advances by one sample.
    Both are interpolated multilinearly; a state outside the grid is moved to the nearest inside.
    """

    given = "truth"
    """Input of `feedback`, under sensors too: the optimum sees the state."""

    name = "optimal"

    def __init__(self, periodic: PeriodicPlant, optimum: PeriodicOptimum) -> None:
        self.optimum = optimum
        self._periodic = periodic
        self._problem = periodic.plant.problem
        # The first `prepare` makes it 0.
        self._sample = -1
        self._phase = -1
        self._table: PolicyTable | None = None

    @classmethod
    def from_scenario(
        cls,
        scenario: Scenario,
        *,
        progress: StepProgress | None = None,
    ) -> PeriodicPolicy:
        """Policy of a scenario with signals: stored, or solved now and kept.

        Args:
            scenario: The scenario.
            progress: Called after each step of the solver.

        Raises:
            OptimumError: A stored file is damaged, or the problem is not solved.
        """
        periodic = periodic_plant(scenario)
        key = periodic_key(periodic, Settings())
        path = stored_file(key)
        if path is None:
            solution = solve_periodic(periodic, progress=progress)
            path = keep_periodic(key, periodic, solution)
        # Read back in any case: a policy that was solved now is the one that is stored.
        return cls(periodic, read_periodic(path, key))

    @property
    def gain(self) -> float:
        """J*: mean of economic cost and penalty per sample over a period."""
        return self.optimum.gain

    def reset(self) -> None:
        """Start the clock."""
        self._sample = -1

    def prepare(self) -> None:
        """Advance the clock by one sample."""
        self._sample += 1

    def feedback(self, s: ArrayLike, a: ArrayLike | None = None) -> Decision:
        """π*(s) and V*(s) at the present phase; `clamped` outside the grid.

        Args:
            s: State in the model's units, (n,).
            a: Not given: what another action is worth is not stored.

        Raises:
            QpError: s is not finite.
            OptimumError: `a` is given.
        """
        if a is not None:
            raise OptimumError("the optimal policy of a period has no value of another action")
        state, row, status = look_up(self._table_of_phase(), self._problem, s)
        W = row.pop()
        value = W + self._problem.penalty(state)
        return Decision(np.array(row), value, status, 0.0)

    def _table_of_phase(self) -> PolicyTable:
        """The table of the present phase, made once for its sample."""
        phase = max(self._sample, 0) % self._periodic.period
        if self._table is None or phase != self._phase:
            optimum = self.optimum
            axes = optimum.grid.axes
            self._table = PolicyTable(axes, optimum.actions[phase], optimum.W[phase])
            self._phase = phase
        return self._table
