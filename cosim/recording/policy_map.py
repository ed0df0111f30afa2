"""The policy and the value over the first two states, as a map that changes with training."""

from __future__ import annotations

from math import isfinite

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from matplotlib import colormaps
from numpy.typing import NDArray

from cosim.protocols import Controller, is_solver_failure
from cosim.recording.glyphs import drawable
from cosim.recording.palette import BOUND, FRAME, packed
from cosim.recording.stream import SAMPLE, Stream, mark
from cosim.scenario import Scenario

ENTITY = "policy"
CELLS = 15

Array = NDArray[np.float64]


class PolicyMap:
    """Draws π and V over the first two states, around the operating point; a cell is a pixel.

    Arrows: (π(s) − u_s)/(u_u − u_l), right the first input, up the second, their length with the
    root of their size. Colour: V(s) above its least, logarithmic, dark low and bright high. The
    values stay readable as the signals `policy/<input>` and `policy/value`, (ny·nx,) row by row,
    NaN where the controller failed.
    """

    def __init__(self, stream: Stream, scenario: Scenario) -> None:
        self._stream, self._scenario = stream, scenario
        self._x, self._y = (_grid(scenario, i) for i in range(2))
        self._height, self._width = len(self._y), len(self._x)
        columns, rows = np.meshgrid(np.arange(self._width), np.arange(self._height)[::-1])
        self._centres = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
        names = [f"policy/{name}" for name in (*scenario.plant.actions[:2], "value")]
        stream.static(f"{ENTITY}/signals", mark(names, [""] * len(names)))
        style = rr.Arrows2D.from_fields(colors=packed("#FFFFFF"), radii=0.05, draw_order=20.0)
        stream.static(f"{ENTITY}/map/actions", style)
        self._frame(self._x, self._y)

    def view(self) -> rrb.Spatial2DView:
        """The map's view."""
        margin = 0.14 * self._width
        bounds = rrb.VisualBounds2D(
            x_range=(-margin, self._width + 0.5 * margin), y_range=(-margin, self._height + margin)
        )
        origin = f"/{ENTITY}/map"
        return rrb.Spatial2DView(name="policy and value", origin=origin, visual_bounds=bounds)

    def send(self, sample: int, controller: Controller) -> None:
        """Draw a controller's first answer in every grid state, as it is at a sample."""
        answers = np.array([[self._answer(controller, x, y) for x in self._x] for y in self._y])
        controller.reset()
        times = [rr.TimeColumn(SAMPLE, sequence=[sample])]
        row = np.moveaxis(answers, -1, 0).reshape(1, -1)
        self._stream.scalars(f"{ENTITY}/signals", times, row)
        scenario = self._scenario
        width = (scenario.action_upper - scenario.action_lower)[:2]
        field = (answers[..., :2] - scenario.reference_action[:2]) / width
        size = np.hypot(field[..., 0], field[..., 1])[..., None]
        arrows = 1.6 * field / np.sqrt(np.where(size > 0, size, 1.0)) * (1.0, -1.0)
        vectors = np.nan_to_num(arrows.reshape(-1, 2))
        self._stream.columns(
            f"{ENTITY}/map/actions",
            times,
            rr.Arrows2D.columns(
                vectors=vectors.astype(np.float32),
                origins=(self._centres - vectors / 2).astype(np.float32),
            ).partition([len(vectors)]),
        )
        self._stream.columns(f"{ENTITY}/map/value", times, _image(answers[::-1, :, 2]))

    def _answer(self, controller: Controller, x: float, y: float) -> list[float]:
        """First two actions and the value in a state, at the guess that a reset gives."""
        state = self._scenario.reference_state.copy()
        state[:2] = x, y
        controller.reset()
        try:
            controller.prepare()
            solution = controller.feedback(state)
        except Exception as error:
            if not is_solver_failure(error):
                raise
            return [np.nan] * 3
        return [float(solution.action[0]), float(solution.action[1]), float(solution.value)]

    def _frame(self, x: Array, y: Array) -> None:
        """Bounds of the states, the axes' ends, and what the arrows mean."""
        width, height = self._width, self._height
        lines = []
        for bound in (self._scenario.state_lower, self._scenario.state_upper):
            if x[0] <= bound[0] <= x[-1]:
                at = float(np.interp(bound[0], x, np.arange(width))) + 0.5
                lines.append([[at, 0.0], [at, height]])
            if y[0] <= bound[1] <= y[-1]:
                at = height - 0.5 - float(np.interp(bound[1], y, np.arange(height)))
                lines.append([[0.0, at], [width, at]])
        if lines:
            red = packed(BOUND)
            style = rr.LineStrips2D(lines, colors=red, radii=0.004 * width, draw_order=15.0)
            self._stream.static(f"{ENTITY}/map/bounds", style)
        (first, second), actions = self._scenario.plant.states[:2], self._scenario.plant.actions
        texts = {
            f"{first} {x[0]:.4g}": (0.5, height),
            f"{first} {x[-1]:.4g}": (width - 0.5, height),
            f"{second} {y[0]:.4g}": (-0.07 * width, height - 1.5),
            f"{second} {y[-1]:.4g}": (-0.07 * width, 0.0),
            f"arrows: {actions[0]} right, {actions[1]} up; colour: V": (
                width / 2,
                -0.11 * height,
            ),
        }
        self._stream.static(
            f"{ENTITY}/map/frame",
            rr.Points2D(
                list(texts.values()),
                labels=[drawable(text) for text in texts],
                colors=packed(FRAME),
                radii=0.001,
                show_labels=True,
            ),
        )


def _grid(scenario: Scenario, i: int) -> Array:
    """Values of state i around the operating point: 6 % of the distance of its bounds each way."""
    width = float(scenario.state_upper[i] - scenario.state_lower[i])
    centre = float(scenario.reference_state[i])
    half = 0.06 * width if isfinite(width) else 0.1 * abs(centre) or 1.0
    return np.linspace(centre - half, centre + half, CELLS)


def _image(values: Array) -> rr.ComponentColumnList:
    """Values (ny, nx) as one image, its rows from top to bottom."""
    known = np.isfinite(values)
    level = np.zeros(values.shape)
    if known.any():
        above = values - values[known].min()
        level = np.log1p(above / (np.median(above[known]) or 1.0))
        level /= level[known].max() or 1.0
    pixels = (255 * colormaps["viridis"](np.where(known, level, np.nan))).astype(np.uint8)
    layout = rr.components.ImageFormat(
        width=values.shape[1], height=values.shape[0], color_model="RGBA", channel_datatype="U8"
    )
    return rr.Image.columns(buffer=[pixels.tobytes()], format=[layout])
