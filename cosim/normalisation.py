"""The environment as learners of neural networks want it: float32, all of the size of one."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from cosim.errors import PlantError
from cosim.scenario import Scenario

Array = NDArray[np.float64]
Single = NDArray[np.float32]
SHARE = 0.1


class Normalisation:
    """Maps a scenario's states, actions and costs to numbers of the size of one, and back.

    A state counts from the operating point in tenths of its magnitude (of its bounds' width where
    that is 0), an action from −1 to 1 across its range, a reward is minus the cost beyond the
    operating point's in tenths of that cost: none of this moves an optimum.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        width = scenario.state_upper - scenario.state_lower
        magnitude = np.abs(scenario.reference_state)
        self.state_scale: Array = SHARE * np.where(magnitude > 0, magnitude, width)
        cost = scenario.controller.reference_cost
        self.reference_cost, self.cost_scale = cost, SHARE * abs(cost) or 1.0

    def observation(self, s: NDArray[np.floating]) -> Single:
        """States s (n,) in physical units as the learner sees them, float32."""
        return ((s - self._scenario.reference_state) / self.state_scale).astype(np.float32)

    def action(self, normalised: ArrayLike) -> Array:
        """Action in physical units (m,) from one in [−1, 1]; raises PlantError on a wrong shape."""
        lower, upper = self._scenario.action_lower, self._scenario.action_upper
        values = np.asarray(normalised, dtype=np.float64)
        if values.shape != lower.shape:
            raise PlantError(f"an action has shape {lower.shape}, not {values.shape}")
        return lower + 0.5 * (np.clip(values, -1.0, 1.0) + 1.0) * (upper - lower)

    def reward(self, cost: float) -> float:
        """Reward of a sample from its ℓ + penalty."""
        return (self.reference_cost - cost) / self.cost_scale


class NormalisedEnv(gymnasium.Wrapper[Single, Any, Array, Any]):
    """A `PlantEnv` behind its scenario's `Normalisation`; `info` stays in physical units."""

    def __init__(self, env: Any, scenario: Scenario) -> None:
        super().__init__(env)
        self.normalisation = Normalisation(scenario)
        seen = env.observation_space
        assert isinstance(seen, Box)
        with np.errstate(over="ignore"):
            low, high = map(self.normalisation.observation, (seen.low, seen.high))
        ones = np.ones(len(scenario.plant.actions), dtype=np.float32)
        self.observation_space = Box(low, high, dtype=np.float32)
        self.action_space = Box(-ones, ones, dtype=np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Single, dict[str, Any]]:
        """Start an episode, as `PlantEnv.reset` does; `options` are in physical units."""
        s, info = self.env.reset(seed=seed, options=options)
        return self.normalisation.observation(s), info

    def step(self, action: Any) -> tuple[Single, float, bool, bool, dict[str, Any]]:
        """Hold an action of [−1, 1]ᵐ for one sample."""
        normalisation = self.normalisation
        s, reward, terminated, truncated, info = self.env.step(normalisation.action(action))
        scaled = normalisation.reward(-float(reward))
        return normalisation.observation(s), scaled, terminated, truncated, info
