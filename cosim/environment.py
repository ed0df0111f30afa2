"""The plant as a Gymnasium environment, `cosim/Evaporator-v0`.

Importing this module registers it: `gymnasium.make("cosim.environment:cosim/Evaporator-v0")`, and
`gymnasium.make_vec` with the same name makes many of them.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from cosim.errors import PlantError
from cosim.plant import FmuPlant
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds

Array = NDArray[np.float64]
EPISODE_STEPS = 500
_SEED_LIMIT = 1 << 63


def _spaces(plant: FmuPlant) -> tuple[gymnasium.Space[Array], gymnasium.Space[Array]]:
    """Observation space, as wide as the FMU says its states can be, and action space."""
    observation = Box(*plant.state_range, dtype=np.float64)
    lower, upper = plant.scenario.action_lower.copy(), plant.scenario.action_upper.copy()
    action = Box(lower, upper, dtype=np.float64)
    return cast("gymnasium.Space[Array]", observation), cast("gymnasium.Space[Array]", action)


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
        applied = self._plant.scenario.saturate(action)
        s, stage_cost, penalty, disturbance = self._plant.step(applied)
        info = {"stage_cost": stage_cost, "penalty": penalty, "disturbance": disturbance}
        return s, -(stage_cost + penalty), False, False, info

    def close(self) -> None:
        """Free the plant."""
        self._plant.close()


def _plant_seed(seed: int | None, rng: np.random.Generator) -> int:
    if seed is not None:
        return spawn_seeds(seed)[0]
    return int(rng.integers(_SEED_LIMIT))


gymnasium.register(
    "cosim/Evaporator-v0",
    entry_point="cosim.environment:PlantEnv",
    max_episode_steps=EPISODE_STEPS,
)
