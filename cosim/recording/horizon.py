"""The predicted trajectory at the time cursor, drawn as one strip for each signal."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, log10

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from cosim.recording.glyphs import drawable
from cosim.recording.palette import BOUND, FRAME, REFERENCE, packed, packed_all
from cosim.recording.stream import Stream

ENTITY = "prediction"
WIDTH, HEIGHT, GAP = 4.0, 1.0, 0.5


@dataclass(frozen=True)
class Strip:
    """One signal's plot: its label, colour, value window (low, high), bounds and reference."""

    label: str
    color: str
    window: tuple[float, float]
    bounds: tuple[float, float]
    reference: float

    def height(self, values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Drawing height of values (any shape): 0 at the window's top, `HEIGHT` at its bottom."""
        low, high = self.window
        return HEIGHT * (1.0 - np.clip((values - low) / (high - low), -0.08, 1.08))


class Horizon:
    """Draws predictions into a stream; n state strips, then m action strips, top to bottom.

    The strips' coordinates are a drawing (float32, clipped to each window). The values themselves
    are the signals `prediction/<name>`, N+1 or N numbers a sample.
    """

    def __init__(self, stream: Stream, states: list[Strip], actions: list[Strip], stages: int):
        self._stream, self._states, self._actions = stream, states, actions
        for kind, group in (("states", states), ("actions", actions)):
            colors = packed_all([strip.color for strip in group])
            style = rr.LineStrips2D.from_fields(colors=colors, radii=0.02)
            stream.static(f"{ENTITY}/{kind}", style)
        self._stages = stages
        strips = [*states, *actions]
        for row, strip in enumerate(strips):
            self._frame(row, strip)
        bottom = len(strips) * (HEIGHT + GAP)
        stream.static(
            f"{ENTITY}/frame/axis",
            rr.Points2D(
                [[x * WIDTH / stages, bottom - GAP * 0.8] for x in (0, stages)],
                labels=["now", f"+{stages} samples"],
                radii=0.001,
                colors=packed(FRAME),
                show_labels=True,
            ),
        )

    def _frame(self, row: int, strip: Strip) -> None:
        top = row * (HEIGHT + GAP)
        entity = f"{ENTITY}/frame/{row}"
        low_y, x = top + HEIGHT, WIDTH
        lines = [[[0.0, top], [x, top], [x, low_y], [0.0, low_y], [0.0, top]]]
        colors = [FRAME]
        inside = [(strip.reference, REFERENCE), *((bound, BOUND) for bound in strip.bounds)]
        for value, color in inside:
            if strip.window[0] <= value <= strip.window[1]:
                y = top + float(strip.height(np.array(value)))
                lines.append([[0.0, y], [WIDTH, y]])
                colors.append(color)
        self._stream.static(entity, rr.LineStrips2D(lines, colors=packed_all(colors), radii=0.008))
        low, high = strip.window
        digits = max(0, 2 - floor(log10(high - low)))
        self._stream.static(
            f"{entity}/labels",
            rr.Points2D(
                [[WIDTH / 2, top - 0.27], [-0.32, top - 0.1], [-0.32, top + HEIGHT - 0.12]],
                labels=[drawable(strip.label), f"{high:.{digits}f}", f"{low:.{digits}f}"],
                radii=0.001,
                colors=packed(FRAME),
                show_labels=True,
            ),
        )

    def send(
        self,
        times: list[rr.TimeColumn],
        states: NDArray[np.float64],
        actions: NDArray[np.float64],
    ) -> None:
        """Draw a block: predicted states (K, N+1, n) and actions (K, N, m), held over a stage."""
        stage = np.linspace(0.0, WIDTH, self._stages + 1)
        self._send("states", times, stage, self._rows(states, self._states, 0))
        held = np.repeat(self._rows(actions, self._actions, len(self._states)), 2, axis=2)
        self._send("actions", times, np.repeat(stage, 2)[1:-1], held)

    @staticmethod
    def _rows(values: NDArray[np.float64], strips: list[Strip], row: int) -> NDArray[np.float64]:
        tops = (row + np.arange(len(strips))) * (HEIGHT + GAP)
        heights = [strip.height(values[:, :, i]) + tops[i] for i, strip in enumerate(strips)]
        return np.stack(heights, axis=1)

    def _send(
        self,
        kind: str,
        times: list[rr.TimeColumn],
        x: NDArray[np.float64],
        y: NDArray[np.float64],
    ) -> None:
        samples, strips, points = y.shape
        xy = np.empty((samples * strips, points, 2), dtype=np.float32)
        xy[..., 0] = x
        xy[..., 1] = y.reshape(samples * strips, points)
        lines = rr.LineStrips2D.columns(strips=xy).partition(np.full(samples, strips))
        self._stream.columns(f"{ENTITY}/{kind}", times, lines)
