"""The plant as a Gymnasium environment, single (`cosim/Evaporator-v0`) and vectorised.

Importing this module registers it: `gymnasium.make("cosim.environment:cosim/Evaporator-v0")`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from cosim.errors import PlantError
from cosim.plant import FmuPlant
from cosim.pool import PlantPool
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds

Array = NDArray[np.float64]
EPISODE_STEPS = 500
_SEED_LIMIT = 1 << 63


def _spaces(plant: FmuPlant) -> tuple[gymnasium.Space[Array], gymnasium.Space[Array]]:
    """Observation space, as wide as the FMU says its states can be, and action space."""
    observation = Box(*plant.state_range, dtype=np.float64)
    action = Box(*_limits(plant.scenario), dtype=np.float64)
    return cast("gymnasium.Space[Array]", observation), cast("gymnasium.Space[Array]", action)


def _limits(scenario: Scenario) -> tuple[Array, Array]:
    return scenario.action_lower.copy(), scenario.action_upper.copy()


class PlantEnv(gymnasium.Env[Array, Array]):
    """A scenario's plant: observation x_k (n,), action u_k (m,) in physical units, endless.

    The reward is −(ℓ(x_k, u_k, d_k) + penalty(x_k)), so that J is minus its mean. Actions are
    saturated to the scenario's bounds, as actuators do. `reset(seed=K)` starts the episode that
    `cosim simulate --seed K` runs; a later `reset()` draws a new one. `info` holds `stage_cost`,
    `penalty` and `disturbance` (p,) of the step.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(self, scenario: Scenario | str | Path = "paper") -> None:
        self._plant = FmuPlant(scenario)
        self.observation_space, self.action_space = _spaces(self._plant)
        self._lower, self._upper = _limits(self._plant.scenario)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode; `options={"initial_state": x}` starts it from x (n,)."""
        super().reset(seed=seed)
        unknown = set(options or ()) - {"initial_state"}
        if unknown:
            raise PlantError(f"unknown reset option {sorted(unknown)}; there is initial_state")
        start = (options or {}).get("initial_state")
        return self._plant.reset(_plant_seed(seed, self.np_random), start), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold an action for one sample; never terminates (a TimeLimit truncates)."""
        applied = np.minimum(np.maximum(action, self._lower), self._upper)
        s, stage_cost, penalty, disturbance = self._plant.step(applied)
        info = {"stage_cost": stage_cost, "penalty": penalty, "disturbance": disturbance}
        return s, -(stage_cost + penalty), False, False, info

    def close(self) -> None:
        """Free the plant."""
        self._plant.close()


class PlantVectorEnv(VectorEnv[Array, Array, Any]):
    """Many `PlantEnv` over one plant pool; each is truncated after `max_episode_steps` samples.

    Autoreset is Gymnasium's next-step mode: the step after a truncation ignores its action,
    starts a new episode and gives reward 0.
    """

    metadata = {"autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        scenario: Scenario | str | Path = "paper",
        max_episode_steps: int = EPISODE_STEPS,
    ) -> None:
        self.num_envs = num_envs
        self._pool = PlantPool(scenario, num_envs)
        self.single_observation_space, self.single_action_space = _spaces(self._pool[0])
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._lower, self._upper = _limits(self._pool.scenario)
        self._episode_steps = max_episode_steps
        self._k = np.zeros(num_envs, dtype=int)

    def reset(
        self,
        *,
        seed: int | list[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Start all episodes; an integer seed K gives environment i the seed K + i."""
        if options:
            raise PlantError("the vector environment has no reset options")
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        if isinstance(seed, int):
            super().reset(seed=seed)
        each = seeds or [None] * self.num_envs
        self._k[:] = 0
        return self._pool.reset([_plant_seed(one, self.np_random) for one in each]), {}

    def step(
        self, actions: Array
    ) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]:
        """Step every environment under actions (num_envs, m)."""
        ended = self._k >= self._episode_steps
        applied = np.minimum(np.maximum(actions, self._lower), self._upper)
        p = len(self._pool.scenario.plant.disturbances)
        states = np.empty(self.observation_space.shape or ())
        costs, penalties = np.zeros(self.num_envs), np.zeros(self.num_envs)
        disturbances = np.full((self.num_envs, p), np.nan)
        for i, plant in enumerate(self._pool):
            if ended[i]:
                states[i] = plant.reset(_plant_seed(None, self.np_random))
            else:
                states[i], costs[i], penalties[i], disturbances[i] = plant.step(applied[i])
        self._k = np.where(ended, 0, self._k + 1)
        stepped = ~ended
        info = {
            "stage_cost": costs,
            "_stage_cost": stepped,
            "penalty": penalties,
            "_penalty": stepped,
            "disturbance": disturbances,
            "_disturbance": stepped,
        }
        never = np.zeros(self.num_envs, dtype=bool)
        return states, -(costs + penalties), never, self._k >= self._episode_steps, info

    def close_extras(self, **kwargs: Any) -> None:
        """Free the plants."""
        self._pool.close()


def _plant_seed(seed: int | None, rng: np.random.Generator) -> int:
    if seed is not None:
        return spawn_seeds(seed)[0]
    return int(rng.integers(_SEED_LIMIT))


gymnasium.register(
    "cosim/Evaporator-v0",
    entry_point="cosim.environment:PlantEnv",
    vector_entry_point="cosim.environment:PlantVectorEnv",
    max_episode_steps=EPISODE_STEPS,
)
