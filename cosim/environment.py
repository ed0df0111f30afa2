"""The plant as a Gymnasium environment, `cosim/Evaporator-v0` and its normalised form.

`import cosim.environment` registers both; `gymnasium.make("cosim.environment:cosim/Evaporator-v0")`
imports it by itself, and `gymnasium.make_vec` with the same name makes many of them.
"""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from cosim.core.errors import PlantError, ScenarioError
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario
from cosim.core.signals import Signals, ahead_of
from cosim.core.simulation import spawn_seeds
from cosim.plant import FmuPlant

Single = NDArray[np.float32]
SHARE = 0.1
"""Share of the operating point that is one in normalised units."""
EPISODE_STEPS = 500
SAMPLES_SHOWN = 120
"""Samples that a rendered image looks back."""


class PlantEnv(gymnasium.Env[Array, Array]):
    """A scenario's plant: observation x_k (n,), action u_k (m,) in physical units, endless.

    The reward is −(ℓ(x_k, u_k, d_k) + penalty(x_k)), so that J is minus its mean. Actions are
    saturated to the scenario's bounds, as actuators do. Where the scenario has sensors the
    observation is not x_k but (2·n_y,): of each sensor the last reading and its age in samples; 0
    and −1 before the first one arrives. Behind this it has what is known of each signal then, the
    present value and those of a preview, in the scenario's order. `reset(seed=K)` starts the
    episode that `cosim simulate --seed K` runs; a later `reset()` draws a new one. `info` holds
    `stage_cost`, `penalty` and `disturbance` (p,) of the step.

    Args:
        scenario: a scenario, its name or its file.
        render_mode: `rgb_array`, or None.
        most_steps: samples of an episode, which count where a signal ends or measures a
            disturbance, whose course is foreseen at each reset.

    Raises:
        ScenarioError: a signal ends before so many samples.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (Gymnasium's own convention)

    def __init__(
        self,
        scenario: Scenario | str | Path = "paper",
        *,
        render_mode: str | None = None,
        most_steps: int = EPISODE_STEPS,
    ) -> None:
        self.render_mode = render_mode
        self._plant = FmuPlant(scenario)
        task = self.scenario
        self._most_steps = most_steps
        self._signals = Signals(task) if task.signals else None
        if self._signals is not None:
            try:
                # The last observation is made after the last step.
                self._signals.require(most_steps + 1)
            except ScenarioError:
                self._plant.close()
                raise
        # The FMU's own ranges of its states.
        low, high = self._plant.state_range
        sensors = task.sensors or ()
        n_sensors = len(sensors)
        if sensors:
            # Readings have noise without bounds; the age of one that never came is −1.
            least_reading = np.full(n_sensors, -np.inf)
            least_age = np.full(n_sensors, -1.0)
            low = np.concatenate([least_reading, least_age])
            high = np.full(2 * n_sensors, np.inf)
        # A forecast's error has no bounds.
        n_known = self._n_known
        low = np.concatenate([low, np.full(n_known, -np.inf)])
        high = np.concatenate([high, np.full(n_known, np.inf)])
        self.observation_space = Box(low, high, dtype=np.float64)
        delays = [sensor.delay for sensor in sensors]
        self._delays: Array = np.array(delays, dtype=float)
        self._last_readings: Array = np.zeros(n_sensors)
        self._ages: Array = np.full(n_sensors, -1.0)
        # Gymnasium may write to its arrays, a scenario's are read-only.
        lower = task.action_lower.copy()
        upper = task.action_upper.copy()
        self.action_space = Box(lower, upper, dtype=np.float64)
        # For pictures alone; one state more than actions, that before the first of them.
        self._states: deque[Array] = deque(maxlen=SAMPLES_SHOWN + 1)
        self._actions: deque[Array] = deque(maxlen=SAMPLES_SHOWN)

    @property
    def scenario(self) -> Scenario:
        """The scenario that the plant realises."""
        return self._plant.scenario

    @property
    def _n_known(self) -> int:
        """Values of signals in an observation."""
        count = 0
        for table in self.scenario.signals or ():
            if table.known != "none":
                count += 1 + ahead_of(table, self.scenario)
        return count

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Start an episode.

        Args:
            seed: of the noise; without it a new one is drawn.
            options: `{"initial_state": x}` starts the episode from x (n,).

        Returns:
            The observation, and an empty dictionary.
        """
        super().reset(seed=seed)
        given = options or {}
        unknown = given.keys() - {"initial_state"}
        if unknown:
            raise PlantError(f"unknown reset option {sorted(unknown)}; there is initial_state")
        start = given.get("initial_state")
        if seed is None:
            # Gymnasium's generator, which its first seeded reset has set.
            plant_seed = int(self.np_random.integers(1 << 63))
        else:
            # The noise of a simulation on this seed.
            plant_seed, _ = spawn_seeds(seed)
        if self._signals is not None:
            self._signals.foresee(self._plant, plant_seed, self._most_steps + 1)
        s = self._plant.reset(plant_seed, start)
        self._states.clear()
        self._actions.clear()
        self._states.append(s)
        self._last_readings = np.zeros_like(self._last_readings)
        self._ages = np.full_like(self._ages, -1.0)
        observation = self._observation(s, self._plant.y)
        return observation, {}

    def _observation(self, s: Array, y: Array | None) -> Array:
        """Readings, and behind them the known values of the signals."""
        measured = self._measured(s, y)
        if self._signals is None:
            return measured
        known = self._signals.known(self._plant.k)
        parts = [known[table.name] for table in self.scenario.signals or () if table.name in known]
        return np.concatenate([measured, *parts])

    def _measured(self, s: Array, y: Array | None) -> Array:
        """The state (n,); under sensors the last readings and their ages, (2·n_y,)."""
        if y is None:
            return s
        arrived = ~np.isnan(y)
        has_reading = self._ages >= 0.0
        older = np.where(has_reading, self._ages + 1.0, -1.0)
        # A reading is as old as its delay when it arrives.
        self._ages = np.where(arrived, self._delays, older)
        self._last_readings = np.where(arrived, y, self._last_readings)
        return np.concatenate([self._last_readings, self._ages])

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold an action (m,) for one sample; never terminates (a TimeLimit truncates).

        Raises PlantError on another shape: NumPy would spread one number over all inputs.
        """
        shape = np.shape(action)
        if shape != self.action_space.shape:
            raise PlantError(f"an action has shape {self.action_space.shape}, not {shape}")
        applied = self.scenario.saturate(action)
        number = self._plant.k
        if self._signals is not None and self._signals.measured and number >= self._most_steps:
            raise PlantError(
                f"nothing is foreseen beyond {self._most_steps} samples of an episode: give "
                "most_steps"
            )
        s, stage_cost, penalty, disturbance, y = self._plant.step(applied)
        info = {
            "stage_cost": stage_cost,
            "penalty": penalty,
            "disturbance": disturbance,
        }
        if self._signals is not None:
            self._signals.check_foreseen(disturbance[None], number)
        self._states.append(s)
        self._actions.append(applied)
        observation = self._observation(s, y)
        reward = -(stage_cost + penalty)
        # A task of operation has no end of its own.
        terminated = False
        truncated = False
        return observation, reward, terminated, truncated, info

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the last samples as an RGB image (height, width, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        # Import Matplotlib only where a picture is asked for.
        from cosim.figures.trajectory import episode_image  # noqa: PLC0415

        n_shown = len(self._actions)
        first = self._plant.k - n_shown
        states = np.array(self._states)
        # Right after a reset there is no action, and the array has one axis.
        n_actions = len(self.scenario.plant.actions)
        actions = np.array(self._actions).reshape(n_shown, n_actions)
        units = self._plant.units
        return episode_image(self.scenario, units, first, states, actions)

    def close(self) -> None:
        """Free the plant."""
        self._plant.close()


class NormalisedEnv(gymnasium.Wrapper[Single, Any, Array, Any]):
    """A `PlantEnv` whose states, actions and rewards are float32 numbers of the size of one.

    A state counts from the operating point in tenths of its magnitude, or of its bounds' width
    where that is 0. An action goes from −1 to 1 across its range. A reward is minus the cost beyond
    the operating point's, in tenths of that cost. None of this moves an optimum. `info` stays in
    physical units.
    """

    def __init__(
        self,
        scenario: Scenario | str | Path = "paper",
        *,
        render_mode: str | None = None,
    ) -> None:
        env: Any = PlantEnv(scenario, render_mode=render_mode)
        super().__init__(env)
        task: Scenario = env.scenario
        for kind, tables in (("sensors", task.sensors), ("signals", task.signals)):
            if tables:
                raise PlantError(
                    f"scenario '{task.name}' has {kind}, for whose values there are no normalised "
                    "units: use PlantEnv"
                )
        self._scenario = task
        width = task.state_upper - task.state_lower
        magnitude = np.abs(task.reference_state)
        size = np.where(magnitude > 0, magnitude, width)
        self.state_scale: Array = SHARE * size
        self.reference_cost = task.controller.reference_cost
        # A cost of 0 gives no scale.
        self.cost_scale = SHARE * abs(self.reference_cost) or 1.0
        # A bound that is none may exceed the floats of 32 bits.
        with np.errstate(over="ignore"):
            low = self._normalised(env.observation_space.low)
            high = self._normalised(env.observation_space.high)
        ones = np.ones(len(task.plant.actions), dtype=np.float32)
        self.observation_space = Box(low, high, dtype=np.float32)
        self.action_space = Box(-ones, ones, dtype=np.float32)

    def _normalised(self, s: NDArray[np.floating]) -> Single:
        deviation = s - self._scenario.reference_state
        scaled = deviation / self.state_scale
        return scaled.astype(np.float32)

    def reset(
        self,
        *,
        seed: int | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Single, dict[str, Any]]:
        """Start an episode, as `PlantEnv.reset` does.

        Args:
            seed: of the noise; without it a new one is drawn.
            options: in physical units.
        """
        s, info = self.env.reset(seed=seed, options=options)
        return self._normalised(s), info

    def step(self, action: ArrayLike) -> tuple[Single, float, bool, bool, dict[str, Any]]:
        """Hold an action of [−1, 1]ᵐ for one sample; raises PlantError on another shape."""
        lower = self._scenario.action_lower
        upper = self._scenario.action_upper
        values = np.asarray(action, dtype=np.float64)
        if values.shape != lower.shape:
            raise PlantError(f"an action has shape {lower.shape}, not {values.shape}")
        # An agent's noise may carry it beyond; the actuators saturate.
        clipped = np.clip(values, -1.0, 1.0)
        share = 0.5 * (clipped + 1.0)
        width = upper - lower
        physical = lower + share * width
        s, reward, terminated, truncated, info = self.env.step(physical)
        # The reward is minus the cost: its excess is counted from the operating point's.
        excess = self.reference_cost + float(reward)
        scaled = excess / self.cost_scale
        observation = self._normalised(s)
        return observation, scaled, terminated, truncated, info


_ENVIRONMENTS = {
    "cosim/Evaporator-v0": "cosim.environment:PlantEnv",
    "cosim/EvaporatorNormalised-v0": "cosim.environment:NormalisedEnv",
}
for _name, _entry_point in _ENVIRONMENTS.items():
    # Gymnasium warns of a name that is registered twice, as by a module that is loaded anew.
    if _name not in gymnasium.registry:
        gymnasium.register(_name, _entry_point, max_episode_steps=EPISODE_STEPS)
