"""The policy and the value over the first two states, as a map that changes with training."""

from __future__ import annotations

import numpy as np
import rerun as rr
from matplotlib import colormaps
from numpy.typing import NDArray

from cosim.recording.channels import Range
from cosim.recording.palette import BOUND, FRAME, packed
from cosim.recording.stream import SAMPLE, UPDATE, Stream, mark
from cosim.recording.text import drawable
from cosim.scenario import Scenario

ENTITY = "policy"

Array = NDArray[np.float64]


class PolicyMap:
    """Draws π and V on the grid x (nx,), y (ny,) of the first two states; a grid cell is a pixel.

    Arrows: (π(s) − u_s)/(u_u − u_l), right the first input, up the second, their length with the
    root of their size. Colour: V(s) above its least, logarithmic, dark low and bright high. The
    values stay readable as the signals `policy/<input>` and `policy/value`, (ny·nx,) row by row.
    """

    def __init__(self, stream: Stream, scenario: Scenario, x: Array, y: Array) -> None:
        self._stream, self._scenario = stream, scenario
        self._height, self._width = len(y), len(x)
        columns, rows = np.meshgrid(np.arange(len(x)), np.arange(len(y))[::-1])
        self._centres = np.stack([columns.ravel(), rows.ravel()], axis=1) + 0.5
        names = [*scenario.plant.actions[:2], "value"]
        self._entities = [f"{ENTITY}/signals/{i}" for i in range(len(names))]
        for entity, name in zip(self._entities, names, strict=True):
            stream.static(entity, mark(f"policy/{name}", ""))
        style = rr.Arrows2D.from_fields(colors=packed("#FFFFFF"), radii=0.05, draw_order=20.0)
        stream.static(f"{ENTITY}/map/actions", style)
        self._frame(x, y)

    @property
    def bounds(self) -> tuple[Range, Range]:
        """Range of the drawing, horizontally and vertically."""
        margin = 0.14 * self._width
        return (-margin, self._width + 0.5 * margin), (-margin, self._height + margin)

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
            f"{first} {x[0]:g}": (0.5, height),
            f"{first} {x[-1]:g}": (width - 0.5, height),
            f"{second} {y[0]:g}": (-0.07 * width, height - 1.5),
            f"{second} {y[-1]:g}": (-0.07 * width, 0.0),
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

    def send(self, update: int, sample: int, actions: Array, values: Array) -> None:
        """Draw π (ny, nx, 2) and V (ny, nx) as they are after an update, at a sample."""
        times = [
            rr.TimeColumn(SAMPLE, sequence=[sample]),
            rr.TimeColumn(UPDATE, sequence=[update]),
        ]
        columns = (actions[..., 0], actions[..., 1], values)
        for entity, data in zip(self._entities, columns, strict=True):
            self._stream.scalars(entity, times, data.reshape(1, -1))
        scenario = self._scenario
        width = (scenario.action_upper - scenario.action_lower)[:2]
        field = (actions - scenario.reference_action[:2]) / width
        size = np.hypot(field[..., 0], field[..., 1])[..., None]
        arrows = 1.6 * field / np.sqrt(np.where(size > 0, size, 1.0)) * (1.0, -1.0)
        vectors = arrows.reshape(-1, 2)
        self._stream.columns(
            f"{ENTITY}/map/actions",
            times,
            rr.Arrows2D.columns(
                vectors=vectors.astype(np.float32),
                origins=(self._centres - vectors / 2).astype(np.float32),
            ).partition([len(vectors)]),
        )
        self._stream.columns(f"{ENTITY}/map/value", times, _image(values[::-1]))


def _image(values: Array) -> rr.ComponentColumnList:
    """Values (ny, nx) as one image, its rows from top to bottom."""
    above = values - np.nanmin(values)
    level = np.log1p(above / (np.nanmedian(above) or 1.0))
    pixels = (255 * colormaps["viridis"](level / (np.nanmax(level) or 1.0))).astype(np.uint8)
    layout = rr.components.ImageFormat(
        width=values.shape[1], height=values.shape[0], color_model="RGBA", channel_datatype="U8"
    )
    return rr.Image.columns(buffer=[pixels.tobytes()], format=[layout])
