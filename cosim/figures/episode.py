"""The last samples of an episode as an image, for environments that are watched as they run."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from numpy.typing import NDArray

from cosim.figures.style import SERIES, figure, label
from cosim.figures.trajectory import limits, time_unit
from cosim.scenario import Scenario

Array = NDArray[np.float64]


def episode_image(
    scenario: Scenario, units: dict[str, str], first: int, states: Array, actions: Array
) -> NDArray[np.uint8]:
    """Draw states (K+1, n) from sample `first` on and the actions (K, m) between them.

    `units` maps variables' names to their units. Returns an RGB image (height, width, 3).
    """
    plant = scenario.plant
    seconds: Array = scenario.sampling_time * np.arange(first, first + len(states), dtype=float)
    scale, unit = time_unit(seconds)
    time = seconds / scale
    names = [*plant.states, *plant.actions]
    with figure(1.3 * len(names), 6.0) as drawn:
        panels = drawn.subplots(len(names), 1, sharex=True, squeeze=False)[:, 0]
        for i in range(len(plant.states)):
            panels[i].plot(time, states[:, i], color=SERIES[0])
            limits(panels[i], scenario.state_lower[i], scenario.state_upper[i])
        for j, panel in enumerate(panels[len(plant.states) :]):
            panel.stairs(actions[:, j], time, color=SERIES[2], baseline=None)
            limits(panel, scenario.action_lower[j], scenario.action_upper[j])
        for panel, name in zip(panels, names, strict=True):
            panel.set_ylabel(label(name, units[name]))
        panels[-1].set_xlabel(f"time [{unit}]")
        panels[-1].set_xlim(time[0], time[-1] if len(time) > 1 else time[0] + 1.0)
        drawn.align_ylabels()
        canvas: Any = FigureCanvasAgg(drawn)
        canvas.draw()
        return np.asarray(canvas.buffer_rgba())[..., :3].copy()
