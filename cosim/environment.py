"""The plant as a Gymnasium environment, `cosim/Evaporator-v0` and its normalised form.

`import cosim` registers them; `gymnasium.make("cosim:cosim/Evaporator-v0")` imports it by itself,
and `gymnasium.make_vec` with the same name makes many of them.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from cosim.errors import PlantError
from cosim.normalisation import NormalisedEnv
from cosim.plant import FmuPlant
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds

Array = NDArray[np.float64]
SHOWN = 120
"""Samples that a rendered image looks back."""
_SEED_LIMIT = 1 << 63


def _spaces(plant: FmuPlant) -> tuple[gymnasium.Space[Array], gymnasium.Space[Array]]:
    """Observation space, as wide as the FMU says its states can be, and action space."""
    observation = Box(*plant.state_range, dtype=np.float64)
    lower, upper = plant.scenario.action_lower.copy(), plant.scenario.action_upper.copy()
    action = Box(lower, upper, dtype=np.float64)
    return observation, action


class PlantEnv(gymnasium.Env[Array, Array]):
    """A scenario's plant: observation x_k (n,), action u_k (m,) in physical units, endless.

    The reward is −(ℓ(x_k, u_k, d_k) + penalty(x_k)), so that J is minus its mean. Actions are
    saturated to the scenario's bounds, as actuators do. `reset(seed=K)` starts the episode that
    `cosim simulate --seed K` runs; a later `reset()` draws a new one. `info` holds `stage_cost`,
    `penalty` and `disturbance` (p,) of the step.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(
        self, scenario: Scenario | str | Path = "paper", *, render_mode: str | None = None
    ) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise PlantError(
                f"there is no render mode '{render_mode}'; there is rgb_array, and through "
                "gymnasium.make human"
            )
        self.render_mode = render_mode
        self._plant = FmuPlant(scenario)
        self.observation_space, self.action_space = _spaces(self._plant)
        self._states: deque[Array] = deque(maxlen=SHOWN + 1)
        self._actions: deque[Array] = deque(maxlen=SHOWN)

    @property
    def scenario(self) -> Scenario:
        """The scenario that the plant realises."""
        return self._plant.scenario

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode; `options={"initial_state": x}` starts it from x (n,)."""
        super().reset(seed=seed)
        unknown = set(options or ()) - {"initial_state"}
        if unknown:
            raise PlantError(f"unknown reset option {sorted(unknown)}; there is initial_state")
        start = (options or {}).get("initial_state")
        s = self._plant.reset(_plant_seed(seed, self.np_random), start)
        self._states.clear()
        self._actions.clear()
        self._states.append(s)
        return s, {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold an action (m,) for one sample; never terminates (a TimeLimit truncates).

        Raises PlantError on another shape: NumPy would spread one number over all inputs.
        """
        if np.shape(action) != self.action_space.shape:
            raise PlantError(
                f"an action has shape {self.action_space.shape}, not {np.shape(action)}"
            )
        applied = self.scenario.saturate(action)
        s, stage_cost, penalty, disturbance = self._plant.step(applied)
        info = {"stage_cost": stage_cost, "penalty": penalty, "disturbance": disturbance}
        self._states.append(s)
        self._actions.append(applied)
        return s, -(stage_cost + penalty), False, False, info

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the last samples as an RGB image (height, width, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        # Matplotlib is for those who look.
        from cosim.figures.trajectory import episode_image  # noqa: PLC0415

        first = self._plant.k - len(self._actions)
        states = np.array(self._states)
        actions = np.array(self._actions).reshape(-1, len(self.scenario.plant.actions))
        return episode_image(self.scenario, self._plant.units, first, states, actions)

    def close(self) -> None:
        """Free the plant."""
        self._plant.close()


def _plant_seed(seed: int | None, rng: np.random.Generator) -> int:
    if seed is not None:
        return spawn_seeds(seed)[0]
    return int(rng.integers(_SEED_LIMIT))


def normalised(
    scenario: Scenario | str | Path = "paper", *, render_mode: str | None = None
) -> NormalisedEnv:
    """`PlantEnv` with observations, actions and rewards of the size of one, float32."""
    env = PlantEnv(scenario, render_mode=render_mode)
    return NormalisedEnv(env, env.scenario)
