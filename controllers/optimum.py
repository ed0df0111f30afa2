"""The optimal policy of the stochastic plant, by dynamic programming: the benchmark's yardstick."""

from __future__ import annotations

import itertools
from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import isfinite

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.dynamic_programming import archive
from controllers.dynamic_programming.bellman import BellmanOperator
from controllers.dynamic_programming.plant import PlantProblem, StochasticScenario
from controllers.dynamic_programming.settings import Settings
from controllers.dynamic_programming.solution import Optimum, Progress, solve
from controllers.errors import ModelError, OptimumError, QpError

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class OptimalSolution:
    """Action (m,) and value at a state; `status` is `solved`, or `clamped` outside the grid."""

    action: Vector
    value: float
    status: str = "solved"
    residual: float = 0.0
    predicted_states: None = None
    predicted_actions: None = None


class OptimalPolicy:
    """π* and V* = penalty + W of a problem under a disturbance law, from a solved grid.

    For the average-cost criterion V* is the differential value: the cost in excess of J* that a
    start in s brings, up to a constant. Between grid states π* and W are interpolated
    multilinearly; a state outside the grid's box is served by the nearest one inside.
    Interpolating π* costs nothing that can be measured, since π* is smooth where the plant lives
    and Q* is flat at its minimum, while minimising Q* anew in each sample costs milliseconds.
    """

    name = "optimal"

    def __init__(self, plant: PlantProblem, optimum: Optimum) -> None:
        problem = plant.problem
        self.problem, self.optimum = problem, optimum
        self._plant = plant
        m = problem.n_actions
        if optimum.actions.shape[1] != m or len(optimum.grid.axes) != problem.n_states:
            raise OptimumError(
                f"the policy has {len(optimum.grid.axes)} states and {optimum.actions.shape[1]} "
                f"actions, the problem {problem.n_states} and {m}"
            )
        self._axes = [axis.tolist() for axis in optimum.grid.axes]
        self._strides = [int(np.prod(optimum.grid.shape[i + 1 :])) for i in range(len(self._axes))]
        self._table = np.column_stack([optimum.actions, optimum.W]).tolist()
        self._corners = [
            (corner, sum(s for s, high in zip(self._strides, corner, strict=True) if high))
            for corner in itertools.product((False, True), repeat=len(self._axes))
        ]

    @classmethod
    def from_scenario(
        cls,
        scenario: StochasticScenario,
        settings: Settings | None = None,
        *,
        overrides: Mapping[str, float | None] | None = None,
        progress: Callable[[Progress], None] | None = None,
    ) -> OptimalPolicy:
        """Optimal policy of a scenario: shipped, cached, or solved now and then cached.

        The plant is the scenario's model of it with the physical parameters and the law that the
        scenario sets; `overrides` replaces plant parameters by name. Raises OptimumError where
        they are not the model's, or a stored file is damaged.
        """
        plant = PlantProblem.from_scenario(scenario, overrides)
        settings = settings or Settings()
        optimum = archive.obtain(
            archive.key(plant, settings),
            plant.problem,
            lambda: solve(plant, settings, progress=progress),
        )
        return cls(plant, optimum)

    @classmethod
    def stored(
        cls, scenario: StochasticScenario, *, overrides: Mapping[str, float | None] | None = None
    ) -> OptimalPolicy | None:
        """Optimal policy of a scenario if its solution is shipped or cached, else None.

        None too where the scenario is none that could be solved. Raises OptimumError on a damaged
        file.
        """
        try:
            plant = PlantProblem.from_scenario(scenario, overrides)
        except (ModelError, OptimumError):
            return None
        name = archive.key(plant, Settings())
        path = archive.stored(name)
        if path is None:
            return None
        return cls(plant, archive.read(path, name, plant.problem))

    @property
    def gain(self) -> float:
        """J*: mean of economic cost and penalty per sample under this policy."""
        return self.optimum.gain

    def reset(self) -> None:
        """Do nothing: the policy has no memory."""

    def prepare(self) -> None:
        """Do nothing: all was prepared when the problem was solved."""

    def feedback(self, s: ArrayLike, a: ArrayLike | None = None) -> OptimalSolution:
        """π*(s) and V*(s), or Q*(s, a) where `a` is given; s (n,), a (m,).

        Raises QpError, which a closed loop takes as a failure of the controller, where s or a is
        not finite.
        """
        state: list[float] = np.asarray(s, dtype=np.float64).tolist()
        if len(state) != len(self._axes) or not isfinite(sum(state)):
            raise QpError(
                f"state {state} is not {len(self._axes)} finite numbers", status="bad state"
            )
        row, clamped = self._lookup(state)
        status = "clamped" if clamped else "solved"
        if a is None:
            value = row.pop() + self.problem.penalty(state)
            return OptimalSolution(np.array(row), value, status)
        action = np.array(a, dtype=np.float64)
        return OptimalSolution(action, self.action_value(state, action), status)

    def policy(self, s: ArrayLike) -> Vector:
        """π*(s), (m,)."""
        return self.feedback(s).action

    def value(self, s: ArrayLike) -> float:
        """V*(s)."""
        return self.feedback(s).value

    def action_value(self, s: ArrayLike, a: ArrayLike) -> float:
        """Q*(s, a) = penalty(s) + E[ℓ − J* + γ V*(s₊)], with J* for the average criterion only."""
        state = np.array(s, dtype=np.float64).reshape(1, -1)
        action = np.array(a, dtype=np.float64).reshape(1, -1)
        if action.shape[1] != self.problem.n_actions or not np.isfinite(action).all():
            raise QpError(
                f"action {action[0].tolist()} is not {self.problem.n_actions} finite numbers",
                status="bad action",
            )
        optimum = self.optimum
        smooth = self._operator.values(state, action, optimum.grid, optimum.W)[0]
        baseline = optimum.gain if optimum.discount == 1.0 else 0.0
        return float(smooth) - baseline + self.problem.penalty(state[0].tolist())

    @cached_property
    def _operator(self) -> BellmanOperator:
        optimum = self.optimum
        return BellmanOperator(self._plant, optimum.accuracy, discount=optimum.discount)

    def _lookup(self, state: list[float]) -> tuple[list[float], bool]:
        """Row (action…, W) interpolated at a state in plain Python: a tenth of NumPy's time."""
        base, clamped, fractions = 0, False, []
        for x, axis, stride in zip(state, self._axes, self._strides, strict=True):
            cell = min(max(bisect_right(axis, x) - 1, 0), len(axis) - 2)
            fraction = (x - axis[cell]) / (axis[cell + 1] - axis[cell])
            if not 0.0 <= fraction <= 1.0:
                fraction, clamped = min(max(fraction, 0.0), 1.0), True
            base += cell * stride
            fractions.append(fraction)
        row = [0.0] * len(self._table[0])
        for corner, offset in self._corners:
            weight = 1.0
            for fraction, high in zip(fractions, corner, strict=True):
                weight *= fraction if high else 1.0 - fraction
            if weight:
                for i, entry in enumerate(self._table[base + offset]):
                    row[i] += weight * entry
        return row, clamped
