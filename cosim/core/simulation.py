"""The closed loop of a plant and a controller, its indicators, and its progress."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from math import nan
from time import perf_counter
from typing import Any

import numpy as np

from cosim.core.errors import CosimError, PlantError, RunEndedError
from cosim.core.loop import ClosedLoop, Sample, controller_name
from cosim.core.protocols import Array, CompiledLoop, Controller, Plant, Recorder, Solution
from cosim.core.scenario import Scenario
from cosim.core.trajectory import FALLBACK, SIGNALS, Signal, Trajectory
from cosim.core.validation import whole_number

MEASURED = (
    "states", "actions", "stage_cost", "disturbances", "value", "residual", "failed",
    "prepare_time", "feedback_time", "plant_time",
)  # fmt: skip
"""Signals in a row of the loop's table, in order (`cosim.core.protocols.CompiledLoop`)."""
REFRESH = 0.1
"""Seconds between two drawings of a progress bar, at least."""
PREDICTED = ("predicted_states", "predicted_actions")
PART = 500
"""Samples of a part; of more than 10⁵ samples it is longer, since a recording indexes each."""


def spawn_seeds(seed: int) -> tuple[int, np.random.Generator]:
    """Return the plant's seed (64 bits) and the exploration's generator for a run's seed.

    `SeedSequence(seed).spawn(2)`: the first child's first 64-bit word seeds the plant, the second
    child the generator. On one seed two controllers meet the same disturbances and the same
    exploration noise (common random numbers). Raises CosimError on a negative seed.
    """
    seed = whole_number("seed", seed, 0, CosimError)
    plant, exploration = np.random.SeedSequence(seed).spawn(2)
    return int(plant.generate_state(1, np.uint64)[0]), np.random.default_rng(exploration)


def simulate(
    plant: Plant,
    controller: Controller,
    steps: int,
    seed: int,
    *,
    recorder: Recorder | None = None,
    progress: Callable[[int], None] | bool = False,
    residuals: bool = True,
) -> Trajectory:
    """Run a controller on a plant for `steps` samples from the scenario's initial state.

    Each sample: `prepare`, then `feedback(s)`, then the plant steps under the action, saturated to
    the scenario's bounds. `recorder` gets the run in parts; `progress` the number of samples done;
    True draws a bar. Without `residuals` the KKT residuals, which may cost time, are NaN.

    A failed solve has the consequence that `ClosedLoop` says, and is counted. Every other error is
    raised; where the plant fails in mid run it is a RunEndedError, whose `trajectory` has the
    samples before.
    """
    steps = whole_number("steps", steps, 1, CosimError)
    run = _Run(plant, controller, steps, seed, residuals)
    if recorder is not None:
        recorder.start(plant.scenario, controller, seed, steps, plant.units)
    loop: CompiledLoop | None = None
    drives = recorder is None and hasattr(type(plant), "drive")
    drives = drives and getattr(plant, "drivable", False)
    if drives and hasattr(type(controller), "compiled_loop"):
        # The classes' own methods, not a wrapper's.
        loop = controller.compiled_loop(plant.scenario)  # type: ignore[attr-defined]
    try:
        with reporting(progress, plant.scenario.name, steps) as tell:
            if loop is not None:
                run.compiled(loop, tell)
            elif recorder is None:
                run.interpreted(None, tell)
            else:
                with closing(recorder):
                    run.interpreted(recorder.record, tell)
    except PlantError as error:
        if run.done == 0:
            raise
        ended = RunEndedError(f"{error}; the run ended after {run.done} of {steps} samples")
        ended.trajectory = run.trajectory()
        raise ended from error
    return run.trajectory()


class _Run:
    """One run, and the loop that fills its columns."""

    def __init__(
        self, plant: Plant, controller: Controller, steps: int, seed: int, residuals: bool
    ) -> None:
        self._plant, self._controller = plant, controller
        self._loop = ClosedLoop(plant.step, controller, plant.scenario)
        self._scenario: Scenario = plant.scenario
        self._seed, self._steps, self._residuals = seed, steps, residuals
        self._length = min(max(PART, steps // 200), 10 * PART)
        widths = {kind.name: len(kind.names(self._scenario)) for kind in SIGNALS}
        self._ends = np.cumsum([widths[name] for name in MEASURED])
        # Column-major, so that a signal is a column and not a copy of one. What is never written
        # takes no memory; a clock is not as precise as a float of 32 bits.
        self._columns: dict[str, Array] = {
            kind.name: np.zeros(
                (steps, widths[kind.name]) if kind.vector else steps,
                np.float32 if kind.clock else np.float64,
                order="F",
            )
            for kind in SIGNALS
        }
        self._status: list[str] = []
        self._predicted: dict[str, Array] = {}
        self._final_state: Array | None = None
        self.done = 0
        """Number of samples that are stored."""

    def interpreted(
        self, record: Callable[..., None] | None, progress: Callable[[int], None]
    ) -> None:
        """Run the loop in Python.

        Args:
            record: gets each part of the run; None: nobody does.
            progress: is called with the number of samples done.
        """
        rows: list[list[float]] = []
        loop = self._loop
        loop.start(self._plant.reset(spawn_seeds(self._seed)[0]))
        try:
            for k in range(self._steps):
                sample = loop.advance()
                rows.append(self._row(sample))
                solution = sample.solution
                self._status.append(FALLBACK if solution is None else solution.status)
                if record is not None and solution is not None:
                    self._keep_prediction(k, solution)
                if (k + 1) % self._length == 0 or k + 1 == self._steps:
                    self._store(rows, record)
                    progress(k + 1)
        except PlantError:
            # The samples before.
            self._store(rows, record)
            raise
        finally:
            self._final_state = loop.s

    def _row(self, sample: Sample) -> list[float]:
        """A sample's row of the table, in the order of `MEASURED`."""
        solution = sample.solution
        step = sample.step
        value = residual = nan
        if solution is not None:
            value = self._number(solution, "value")
            if self._residuals:
                residual = self._number(solution, "residual")
        return [
            *sample.s.tolist(),
            *sample.a.tolist(),
            step.stage_cost,
            *step.disturbance.tolist(),
            value,
            residual,
            solution is None,
            sample.prepare_time,
            sample.feedback_time,
            sample.plant_time,
        ]

    def _store(self, rows: list[list[float]], record: Callable[..., None] | None) -> None:
        """Store the rows that are not stored yet, hand them to the recorder, and forget them."""
        if not rows:
            return
        first, count = self.done, len(rows)
        columns = self._fill(first, np.array(rows))
        rows.clear()
        if record is not None:
            predicted = {name: values[:count] for name, values in self._predicted.items()}
            record(first, columns | predicted, self._status[first : first + count])
            self._predicted = {}

    def compiled(self, loop: CompiledLoop, progress: Callable[[int], None]) -> None:
        """Run with the controller's loop, to the same columns."""
        self._plant.reset(spawn_seeds(self._seed)[0])
        for first in range(0, self._steps, PART):
            end = min(first + PART, self._steps)
            table = np.full((end - first, self._ends[-1]), nan)
            try:
                self._final_state = self._plant.drive(loop, table)  # type: ignore[attr-defined]
            except PlantError:
                # The plant's time, a row's last number, is written after its step.
                count = int(np.isfinite(table[:, -1]).sum())
                self._final_state = table[count, : self._ends[0]].copy()
                self._keep(first, table[:count])
                raise
            self._keep(first, table)
            progress(end)

    def _keep(self, first: int, table: Array) -> None:
        """Store rows of the compiled loop with their status."""
        failed = self._fill(first, table)["failed"]
        self._status += [FALLBACK if sample_failed else "solved" for sample_failed in failed]

    def _fill(self, first: int, table: Array) -> dict[str, Array]:
        """Store rows of the signals that are `MEASURED`, and those that follow; all by name."""
        self.done = end = first + len(table)
        stored = {name: column[first:end] for name, column in self._columns.items()}
        stored["time"][:] = np.arange(first, end) * self._scenario.sampling_time
        parts = np.split(table, self._ends[:-1], axis=1)
        for name, part in zip(MEASURED, parts, strict=True):
            stored[name][:] = part.reshape(stored[name].shape)
        if not self._residuals:
            stored["residual"][:] = nan
        for kind in SIGNALS:
            if kind.of is not None:
                stored[kind.name][:] = kind.of(self._scenario, stored)
        return stored

    def _number(self, solution: Solution, name: str) -> float:
        """A field of a solution that is a number; raises CosimError where it is none."""
        value = getattr(solution, name, None)
        if type(value) is float:
            return value
        numbers = int | float | np.integer | np.floating
        if isinstance(value, bool) or not isinstance(value, numbers):
            shown = " ".join(f"{value!r:.60}".split())
            number = self._loop.number - 1
            raise self._loop.wrong(f"a {name} that is no number but {shown}", number)
        return float(value)

    def _keep_prediction(self, k: int, solution: Solution) -> None:
        given: Any = {name: getattr(solution, name) for name in PREDICTED}
        if any(values is None for values in given.values()):
            return
        if not self._predicted:
            shapes = {name: (self._length, *np.shape(values)) for name, values in given.items()}
            self._predicted = {name: np.full(shape, nan) for name, shape in shapes.items()}
        try:
            for name, values in given.items():
                self._predicted[name][k % self._length] = values
        except (TypeError, ValueError) as error:
            shape_error = self._loop.wrong(f"a prediction of another shape or kind ({error})", k)
            raise shape_error from None

    def trajectory(self) -> Trajectory:
        scenario = self._scenario
        named, timing = {}, {}
        for kind in SIGNALS:
            values = self._columns[kind.name].reshape(self._steps, -1)[: self.done]
            if kind.clock:
                timing[kind.name.removesuffix("_time")] = values[:, 0]
                continue
            units = kind.units(scenario, self._plant.units)
            for (name, unit), column in zip(units.items(), values.T, strict=True):
                named[name] = Signal(name, unit, np.ascontiguousarray(column))
        return Trajectory(
            scenario=scenario,
            signals=named,
            status=self._status[: self.done],
            timing=timing,
            final_state=self._final_state,
            seed=self._seed,
            controller=controller_name(self._controller),
        )


def functions_of(controller: Any) -> str | None:
    """How a controller's functions are computed, `interpreted` or `compiled`; None without any."""
    mode = getattr(controller, "functions", None)
    return mode if isinstance(mode, str) else None


# key performance indicators of a run


def indicators(run: Trajectory, burn_in: int = 0) -> dict[str, float]:
    """Indicators of a run after its first `burn_in` samples.

    They are `Trajectory.means`, `input_effort` and `failures`, the samples under the fallback.
    """
    lower, upper = run.scenario.action_lower, run.scenario.action_upper
    return run.means(burn_in) | {
        "input_effort": input_effort(run.actions[burn_in:], lower, upper),
        "failures": float(np.sum(run["failed"][burn_in:])),
    }


def measure(
    plant: Plant, controller: Controller, seed: int, steps: int, burn_in: int = 0
) -> tuple[dict[str, float], dict[str, float]]:
    """Indicators of `steps` samples after `burn_in` on a seed's noise, and times.

    Times are `wall_time_s` and quantiles of each phase of a sample in µs.
    """
    begin = perf_counter()
    run = simulate(plant, controller, burn_in + steps, seed, residuals=False)
    clock = {"wall_time_s": perf_counter() - begin}
    for name, quantiles in run.timing_summary().items():
        clock |= {f"{name}_{key}": value for key, value in quantiles.items()}
    return indicators(run, burn_in), clock


def indicators_of(
    plant: Plant, controller: Controller, seeds: Sequence[int], steps: int
) -> dict[str, Array]:
    """`indicators` of a controller on each of S seeds by name, (S,) each."""
    found = [measure(plant, controller, seed, steps)[0] for seed in seeds]
    return {name: np.array([figures[name] for figures in found]) for name in found[0]}


def input_effort(actions: Array, lower: Array, upper: Array) -> float:
    """Mean over samples of Σᵢ |uᵢ,ₖ − uᵢ,ₖ₋₁| / (u_u − u_l)ᵢ, the share of the range moved.

    `actions` (K, m); `lower`, `upper` (m,). One sample moves nothing: 0.
    """
    if len(actions) < 2:
        return 0.0
    return float(np.mean(np.sum(np.abs(np.diff(actions, axis=0)) / (upper - lower), axis=1)))


@contextmanager
def reporting(
    progress: Callable[..., None] | bool,
    label: str,
    total: int,
    read: Callable[..., tuple[int, str]] = lambda done, remark="", *_: (done, remark),
) -> Iterator[Callable[..., None]]:
    """Yield the callback of an argument `progress`: itself, a bar, or a no-op.

    Args:
        progress: a callback, True for a bar on standard error, False for neither.
        label: what the bar is called.
        total: samples of the whole work.
        read: turns what the callback is called with into the number done and a remark.
    """
    if callable(progress) or not progress:
        yield progress or (lambda *news: None)
        return
    from rich import progress as rich_progress  # noqa: PLC0415, only where a bar is drawn
    from rich.console import Console  # noqa: PLC0415

    console = Console(stderr=True)
    if console.is_jupyter:
        # Text, as on a terminal: rich's own display there needs ipywidgets.
        console = Console(stderr=True, force_jupyter=False, force_terminal=True)
    columns = (
        rich_progress.TextColumn("{task.description}"),
        rich_progress.BarColumn(bar_width=20),
        rich_progress.TaskProgressColumn(),
        rich_progress.TimeRemainingColumn(),
        rich_progress.TextColumn("{task.fields[remark]}"),
    )
    # Drawn from here, not by a thread of its own, ten times a second at most.
    with rich_progress.Progress(*columns, console=console, auto_refresh=False) as bar:
        task = bar.add_task(label, total=total, remark="")
        last_drawn = 0.0

        def update(*news: object) -> None:
            nonlocal last_drawn
            done, remark = read(*news)
            bar.update(task, completed=done, remark=remark)
            if perf_counter() - last_drawn >= REFRESH:
                last_drawn = perf_counter()
                bar.refresh()

        yield update
