"""The closed loop of a plant and a controller, its indicators, and its progress.

Every closed loop in Python is `ClosedLoop`, with its rule of a failed solve: a simulation, a
training, a rollout on an empirical model, the search of a back-off on the controller's own model.
Its counterpart in C is `controllers/export/sources/loop.h`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from math import nan
from time import perf_counter
from typing import Any, NamedTuple

import numpy as np

from cosim.core.errors import CosimError, PlantError, RunEndedError
from cosim.core.protocols import (
    ActionLimits,
    Array,
    CompiledLoop,
    Controller,
    Plant,
    Recorder,
    Solution,
    Step,
)
from cosim.core.sensors import require_readings
from cosim.core.signals import Signals
from cosim.core.trajectory import FALLBACK, SIGNALS, Signal, Trajectory
from cosim.core.validation import whole_number

MEASURED = (
    "states", "actions", "stage_cost", "disturbances", "value", "residual", "failed",
    "prepare_time", "feedback_time", "plant_time", "measurements", "estimates",
)  # fmt: skip
"""Signals in a row of the loop's table, in order (`cosim.core.protocols.CompiledLoop`).

The last two are there with sensors, under which no compiled loop runs.
"""
LOOP_STATUSES = ("solved", FALLBACK, "clamped")
"""Statuses by their number in a compiled loop's column `failed`; one is a failure."""
REFRESH = 0.1
"""Seconds between two drawings of a progress bar, at least."""
PREDICTED = ("predicted_states", "predicted_actions")
PART = 500
"""Samples of a part; of more than 10⁵ samples it is longer, since a recording indexes each."""
FIRST_PART = 16
"""Samples of a compiled loop's first part; the next ones are as long as they are fast."""
SLOW = 1e-3
"""Seconds of a sample from which on a part may take longer than `PART_SECONDS`."""
PART_SECONDS = 1.0
"""Seconds between two reports of progress, about, where a part takes longer."""


class Sample(NamedTuple):
    """One sample of a closed loop.

    Attributes:
        s: state x_k, (n,).
        y: what the sensors showed at sample k, (n_y,); None without sensors.
        estimate: the controller's of x_k, (n,); None where it makes none.
        solution: the controller's; None after a failed solve.
        a: applied action u_k, (m,).
        step: what the plant gave, x_{k+1} included.
        prepare_time, feedback_time, plant_time: seconds of the three phases.
    """

    s: Array
    y: Array | None
    estimate: Array | None
    solution: Solution | None
    a: Array
    step: Step
    prepare_time: float
    feedback_time: float
    plant_time: float


class ClosedLoop:
    """A plant and a controller in closed loop.

    A sample is `prepare`, then `feedback(s)`, then the plant steps under the action, saturated to
    the actuators' bounds. Where the plant has sensors the controller is given y in place of s.
    Where the scenario has signals it is told before `prepare` what is known of them then. A
    failed solve is an exception, of either phase, whose class has `is_solver_failure`: the last
    applied action (first the reference action) is then applied once more, and the controller is
    reset. Every other error is raised.

    Args:
        step: the plant, from an action (m,) to what its next sample gave.
        controller: the feedback law.
        limits: bounds of the actuators, and the action of the first fallback.
        keeps_points: whether `point` is read from the controller.
        known: what is known of the scenario's signals at a sample, by its number
            (`cosim.core.signals`); None without signals.

    Attributes:
        lower, upper: bounds of the actuators, (m,).
        s: present state, (n,).
        y: what the sensors show at the present sample, (n_y,); None without sensors.
        number: of samples since the start.
        applied: action of the last sample, (m,); before the first, the reference action.
        solution: for the present state, once it is solved for; None after a failed solve.
        point: where the controller's QP was linearised for `solution`; None after a failed solve.
    """

    def __init__(
        self,
        step: Callable[[Array], Step],
        controller: Controller,
        limits: ActionLimits,
        *,
        keeps_points: bool = False,
        known: Callable[[int], Mapping[str, Array]] | None = None,
    ) -> None:
        self._step = step
        self._controller = controller
        self._limits = limits
        self.lower = limits.action_lower
        self.upper = limits.action_upper
        self._keeps_points = keeps_points
        # Optional methods of a controller that is given measurements (`Controller`).
        self._report_action = getattr(controller, "applied", None)
        self._resume = getattr(controller, "resume", controller.reset)
        self._given = getattr(controller, "given", "state")
        self._inform = getattr(controller, "inform", None)
        self._known = known
        self.s: Array = np.empty(0)
        self.y: Array | None = None
        self.number = 0
        self.applied = limits.reference_action
        self.solution: Any = None
        self.point: Any = None
        self._prepare_time = 0.0
        self._feedback_time = 0.0

    def start(self, s: Array, y: Array | None = None) -> None:
        """Begin an episode.

        Args:
            s: state to which the plant has been reset, (n,).
            y: what its sensors show there, (n_y,); None without sensors.

        Raises:
            CosimError: the plant has sensors, and the controller is made for exact states.
        """
        if y is not None and self._given == "state":
            raise CosimError(
                f"the scenario has sensors, and {controller_name(self._controller)} takes the "
                "exact state: put an estimator before it, "
                "controllers.OutputFeedback.from_scenario(scenario, controller)"
            )
        # As in `step`: whoever is given the state may keep it.
        s.flags.writeable = False
        self.s = s
        self.y = y
        self.number = 0
        self.applied = self._limits.reference_action
        self._controller.reset()

    def advance(self) -> Sample:
        """Solve for the present state, and let the plant take a sample under the action."""
        self.solve()
        return self.step(self.action())

    @property
    def given(self) -> Array:
        """Input of the controller at the present sample: y (n_y,) or the state (n,)."""
        if self.y is None or self._given == "truth":
            return self.s
        return self.y

    def inform(self) -> None:
        """Tell the controller what is known of the scenario's signals at the present sample."""
        if self._known is not None and self._inform is not None:
            self._inform(self._known(self.number))

    def solve(self, prepare: Callable[[], None] | None = None) -> bool:
        """Prepare, and feed the present state back, into `solution`.

        Args:
            prepare: prepares the controller; None: its own `prepare`, told what is known.

        Returns:
            Whether there is a solution.

        Raises:
            CosimError: the controller gave what is no solution.
        """
        begin = middle = perf_counter()
        # The two phases are timed apart: only feedback delays the action.
        try:
            if prepare is None:
                self.inform()
                self._controller.prepare()
            else:
                prepare()
            # Now: a feedback of several QPs linearises elsewhere.
            if self._keeps_points:
                self.point = self._controller.linearisation_point  # type: ignore[attr-defined]
            middle = perf_counter()
            self.solution = self._controller.feedback(self.given)
            end = perf_counter()
            self._check_solution()
        except Exception as error:
            end = perf_counter()
            self._recover(error)
        self._prepare_time = middle - begin
        self._feedback_time = end - middle
        return self.solution is not None

    def solve_for(self, a: Array) -> Any:
        """Solution for Q(s, a) with the preparation of `solve`; None after a failed solve.

        Args:
            a: action that is enforced, (m,).
        """
        try:
            return self._controller.feedback(self.given, a)
        except Exception as error:
            self._recover(error)
            return None

    def action(self) -> Array:
        """The action of the present sample, (m,): the solution's, or the last one once more."""
        if self.solution is None:
            return self.applied
        action = self.solution.action
        # NumPy would spread a number over all inputs, and take truth for one.
        if not isinstance(action, np.ndarray) or action.dtype.kind not in "fiu":
            description = f"{type(action).__name__} {action}"
        elif action.shape != self.lower.shape:
            description = f"shape {action.shape}"
        else:
            return self.saturate(action)
        raise self.wrong(f"an action of {description}, not {self.lower.shape}", number=self.number)

    def saturate(self, action: Array) -> Array:
        """An action (m,) within the actuators' bounds: the QP keeps them to its tolerance only."""
        return np.minimum(np.maximum(action, self.lower), self.upper)

    def step(self, a: Array) -> Sample:
        """Let the plant take a sample.

        Args:
            a: action within the actuators' bounds, (m,).

        Returns:
            The sample; a later change of its states or action is an error.

        Raises:
            PlantError: by the plant; the loop is still before the sample.
        """
        begin = perf_counter()
        step = self._step(a)
        plant_time = perf_counter() - begin
        estimate = None
        # Of an exact state nothing has to be estimated.
        if self.y is not None:
            estimate = getattr(self._controller, "estimate", None)
        sample = Sample(
            self.s,
            self.y,
            estimate,
            self.solution,
            a,
            step,
            self._prepare_time,
            self._feedback_time,
            plant_time,
        )
        # Controllers and rules read these arrays, and may keep them.
        a.flags.writeable = False
        step.s.flags.writeable = False
        self.s = step.s
        self.y = step.y
        self.applied = a
        if self._report_action is not None:
            self._report_action(a)
        self.number += 1
        return sample

    def wrong(self, answer: str, number: int | None = None) -> CosimError:
        """An error that names the controller.

        Args:
            answer: what the controller gave, in words.
            number: of the sample; None where it does not matter.
        """
        where = "" if number is None else f", at step {number}"
        return CosimError(f"{controller_name(self._controller)} gave {answer}{where}")

    def _check_solution(self) -> None:
        """Raise CosimError where a foreign controller's solution lacks an action or a status."""
        solution = self.solution
        if not hasattr(solution, "action"):
            raise self.wrong(f"a {type(solution).__name__}, which is no solution")
        status = getattr(solution, "status", None)
        if not isinstance(status, str):
            raise self.wrong(f"a status that is no text but {status!r:.60}")

    def _recover(self, error: Exception) -> None:
        """The rule of a failed solve; raises every other error."""
        if not getattr(type(error), "is_solver_failure", False):
            raise error
        # What led to the failure is forgotten: the next sample is solved from the reference.
        self._resume()
        self.solution = None
        self.point = None


def controller_name(controller: Any) -> str:
    """Name of a controller for tables: its `name`, else its class's."""
    return str(getattr(controller, "name", type(controller).__name__))


def spawn_seeds(seed: int) -> tuple[int, np.random.Generator]:
    """Return the plant's seed (64 bits) and the exploration's generator for a run's seed.

    `SeedSequence(seed).spawn(2)`: the first child's first 64-bit word seeds the plant, the second
    child the generator. On one seed two controllers meet the same disturbances and the same
    exploration noise (common random numbers). Raises CosimError on a negative seed.
    """
    seed = whole_number("seed", seed, 0, CosimError)
    root = np.random.SeedSequence(seed)
    plant, exploration = root.spawn(2)
    (plant_seed,) = plant.generate_state(1, np.uint64)
    generator = np.random.default_rng(exploration)
    return int(plant_seed), generator


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
    """Run a controller on a plant from the scenario's initial state (`ClosedLoop`).

    A failed solve is counted; every other error is raised. For a long run an NMPC that CasADi
    interprets is compiled, and stays so (`RtiNmpc.compile`, which COSIM_COMPILE=never forbids).

    Args:
        plant: what is controlled.
        controller: the feedback law.
        steps: number of samples.
        seed: of the plant's noise (`spawn_seeds`).
        recorder: gets the run in parts.
        progress: gets the number of samples done, each second or so; True draws a bar.
        residuals: whether the KKT residuals, which may cost time, are asked for; else they are NaN.

    Returns:
        The samples.

    Raises:
        RunEndedError: the plant failed in mid run; its `trajectory` has the samples before.
        ScenarioError: a signal of the scenario, or its preview, ends before the run; a sensor is
            not read in it.
    """
    steps = whole_number("steps", steps, 1, CosimError)
    scenario = plant.scenario
    require_readings(scenario, steps)
    signals = Signals(scenario) if scenario.signals else None
    if signals is not None:
        signals.require(steps)
        plant_seed, _ = spawn_seeds(seed)
        signals.foresee(plant, plant_seed, steps)
    _compile_for(controller, steps)
    # The columns are there before the recorder opens its file: they may not fit the memory.
    run = _Run(plant, controller, steps, seed, residuals, signals)
    if recorder is not None:
        recorder.start(plant.scenario, controller, seed, steps, plant.units)
    # A recorder reads the predictions, which a compiled loop does not keep.
    loop = compiled_loop(plant, controller) if recorder is None else None
    try:
        with reporting(progress, plant.scenario.name, steps) as report:
            if loop is not None:
                run.compiled(loop, report)
            elif recorder is None:
                run.interpreted(None, report)
            else:
                with closing(recorder):
                    run.interpreted(recorder.record, report)
    except PlantError as error:
        # Of a plant that fails at once there is nothing to show.
        if run.done == 0:
            raise
        ended = RunEndedError(f"{error}; the run ended after {run.done} of {steps} samples")
        ended.trajectory = run.trajectory()
        raise ended from error
    trajectory = run.trajectory()
    # A forecast of what followed the actions was made under other ones: such a run is no result.
    if signals is not None:
        signals.check_foreseen(trajectory.disturbances)
    return trajectory


def _compile_for(controller: Controller, steps: int) -> None:
    """Compile an interpreted NMPC, behind an estimator too, if the run is long enough for it."""
    # An estimator (`controllers.OutputFeedback`) has the controller that it feeds.
    nmpc: Any = getattr(controller, "controller", controller)
    is_interpreted = functions_of(nmpc) == "interpreted"
    if is_interpreted and hasattr(type(nmpc), "compile"):
        nmpc.compile(steps)


def compiled_loop(plant: Plant, controller: Controller) -> CompiledLoop | None:
    """The loop of both in compiled code; None where one of them has to be asked in Python.

    Args:
        plant: what is controlled.
        controller: the feedback law.
    """
    # Methods of the classes: a wrapper that hands on all attributes samples in a way of its own.
    if not hasattr(type(plant), "drive"):
        return None
    if not hasattr(type(controller), "compiled_loop"):
        return None
    if not getattr(plant, "drivable", False):
        return None
    nmpc: Any = controller
    loop: CompiledLoop | None = nmpc.compiled_loop(plant.scenario)
    return loop


class _Run:
    """One run, and the loop that fills its columns.

    Attributes:
        done: number of samples that are stored.
    """

    def __init__(
        self,
        plant: Plant,
        controller: Controller,
        steps: int,
        seed: int,
        residuals: bool,
        signals: Signals | None,
    ) -> None:
        scenario = plant.scenario
        self._plant = plant
        self._controller = controller
        self._scenario = scenario
        self._seed = seed
        self._steps = steps
        self._residuals = residuals
        known = None if signals is None else signals.known
        self._loop = ClosedLoop(plant.step, controller, scenario, known=known)
        # Samples of a part, after which progress is reported and a recorder is served.
        part_of_run = max(PART, steps // 200)
        self._length = min(part_of_run, 10 * PART)
        self._columns: dict[str, Array] = {}
        widths = {}
        for kind in SIGNALS:
            width = len(kind.names(scenario))
            widths[kind.name] = width
            # Column-major, so that a signal is a column and not a copy of one. What is never
            # written takes no memory; a clock is not as precise as a float of 32 bits.
            shape = (steps, width) if kind.vector else (steps,)
            dtype = np.float32 if kind.clock else np.float64
            self._columns[kind.name] = np.zeros(shape, dtype, order="F")
        # Where each measured signal ends in a row of the loop's table.
        measured_widths = [widths[name] for name in MEASURED]
        self._ends = np.cumsum(measured_widths)
        self._status: list[str] = []
        # What a part's solutions predict, by name; nothing until one of them does.
        self._predicted: dict[str, Array] = {}
        n_estimates = len(scenario.estimate_names)
        self._without_estimate = np.full(n_estimates, nan)
        self._final_state: Array | None = None
        self.done = 0

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
        plant_seed, _ = spawn_seeds(self._seed)
        s = self._plant.reset(plant_seed)
        y = getattr(self._plant, "y", None)
        loop.start(s, y)
        reported_at = perf_counter()
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
                    continue
                # A clock is asked of slow samples alone.
                seconds = sample.prepare_time + sample.feedback_time + sample.plant_time
                if seconds > SLOW and perf_counter() - reported_at > PART_SECONDS:
                    reported_at = perf_counter()
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
        row = [
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
        if sample.y is not None:
            estimate = self._without_estimate if sample.estimate is None else sample.estimate
            row += [*sample.y.tolist(), *estimate.tolist()]
        return row

    def _store(self, rows: list[list[float]], record: Callable[..., None] | None) -> None:
        """Store the rows that are not stored yet, hand them to the recorder, and forget them."""
        if not rows:
            return
        first = self.done
        count = len(rows)
        # One conversion for a part, not one for each row.
        columns = self._fill(first, np.array(rows))
        rows.clear()
        if record is None:
            return
        for name, values in self._predicted.items():
            columns[name] = values[:count]
        record(first, columns, self._status[first : first + count])
        self._predicted = {}

    def compiled(self, loop: CompiledLoop, progress: Callable[[int], None]) -> None:
        """Run with a loop in compiled code, to the same columns.

        Args:
            loop: the controller's.
            progress: is called with the number of samples done.
        """
        plant: Any = self._plant
        plant_seed, _ = spawn_seeds(self._seed)
        plant.reset(plant_seed)
        # In parts, so that progress is shown and Ctrl-C is heard; short ones of a slow plant.
        length = FIRST_PART
        end = 0
        while end < self._steps:
            begin = perf_counter()
            first = end
            # A part ends where Python's loop reports.
            next_report = first - first % PART + PART
            end = min(first + length, next_report, self._steps)
            n_numbers = self._ends[-1]
            table = np.full((end - first, n_numbers), nan)
            try:
                self._final_state = plant.drive(loop, table)
            except PlantError:
                # The plant's time, a row's last number, is written after its step.
                is_done = np.isfinite(table[:, -1])
                count = int(is_done.sum())
                # The state is a row's first signal; that of the failed step stands there already.
                n_states = self._ends[0]
                self._final_state = table[count, :n_states].copy()
                self._keep(first, table[:count])
                raise
            self._keep(first, table)
            seconds = perf_counter() - begin
            if end in (next_report, self._steps) or seconds > PART_SECONDS / 4:
                progress(end)
            # Longer parts while they are fast: each of them costs a call and its conversion.
            if seconds > PART_SECONDS:
                length = max(1, length // 2)
            elif seconds < PART_SECONDS / 4:
                length = min(2 * length, PART)

    def _keep(self, first: int, table: Array) -> None:
        """Store rows of the compiled loop with their status."""
        # A signal begins where the one before it ends.
        position = self._ends[MEASURED.index("failed") - 1]
        for number in table[:, position]:
            word = LOOP_STATUSES[int(number)]
            self._status.append(word)
        fallback = LOOP_STATUSES.index(FALLBACK)
        table[:, position] = table[:, position] == fallback
        self._fill(first, table)

    def _fill(self, first: int, table: Array) -> dict[str, Array]:
        """Store rows of the signals that are `MEASURED`, and those that follow; all by name."""
        end = first + len(table)
        self.done = end
        # Views of the whole run's columns.
        stored = {}
        for name, column in self._columns.items():
            stored[name] = column[first:end]
        samples = np.arange(first, end)
        # k·h, never a sum of h.
        stored["time"][:] = samples * self._scenario.sampling_time
        parts = np.split(table, self._ends[:-1], axis=1)
        for name, part in zip(MEASURED, parts, strict=True):
            column = stored[name]
            # A signal that is no vector is a column of one axis.
            column[:] = part.reshape(column.shape)
        # A compiled loop has them at no cost; the interpreted one does not ask for them.
        if not self._residuals:
            stored["residual"][:] = nan
        # In the order of their declaration: one may need another.
        for kind in SIGNALS:
            if kind.derive is None:
                continue
            values = kind.derive(self._scenario, stored)
            stored[kind.name][:] = values
        return stored

    def _number(self, solution: Solution, name: str) -> float:
        """A field of a solution that is a number; raises CosimError where it is none."""
        value = getattr(solution, name, None)
        # Of our own controllers always, and a short way for every sample.
        if type(value) is float:
            return value
        numbers = int | float | np.integer | np.floating
        # To Python a truth is a number.
        if isinstance(value, bool) or not isinstance(value, numbers):
            # An array's text has several lines; a message is one.
            words = f"{value!r:.60}".split()
            one_line = " ".join(words)
            # The loop has counted this sample already.
            sample = self._loop.number - 1
            raise self._loop.wrong(f"a {name} that is no number but {one_line}", sample)
        return float(value)

    def _keep_prediction(self, k: int, solution: Solution) -> None:
        """Keep what a solution predicts, for the recorder, if it does."""
        predictions: dict[str, Any] = {}
        for name in PREDICTED:
            values = getattr(solution, name)
            if values is None:
                return
            predictions[name] = values
        row = k % self._length
        try:
            for name, values in predictions.items():
                # The first prediction of a part says how long the horizon is.
                if name not in self._predicted:
                    shape = (self._length, *np.shape(values))
                    self._predicted[name] = np.full(shape, nan)
                # A sample whose solve failed stays without.
                self._predicted[name][row] = values
        except (TypeError, ValueError) as error:
            wrong = self._loop.wrong(f"a prediction of another shape or kind ({error})", k)
            raise wrong from None

    def trajectory(self) -> Trajectory:
        """The samples that are stored."""
        scenario = self._scenario
        signals: dict[str, Signal] = {}
        timing = {}
        for kind in SIGNALS:
            # A signal that is no vector has one column; a run that failed has fewer rows.
            table = self._columns[kind.name].reshape(self._steps, -1)
            values = table[: self.done]
            if kind.clock:
                phase = kind.name.removesuffix("_time")
                timing[phase] = values[:, 0]
                continue
            units = kind.units(scenario, self._plant.units)
            for (name, unit), column in zip(units.items(), values.T, strict=True):
                contiguous = np.ascontiguousarray(column)
                signals[name] = Signal(name, unit, contiguous)
        return Trajectory(
            scenario=scenario,
            signals=signals,
            status=self._status[: self.done],
            timing=timing,
            final_state=self._final_state,
            seed=self._seed,
            controller=controller_name(self._controller),
        )


def functions_of(controller: Any) -> str | None:
    """How a controller's functions are computed, `interpreted` or `compiled`; None without any."""
    mode = getattr(controller, "functions", None)
    # A user's controller may have an attribute of this name for something else.
    if not isinstance(mode, str):
        return None
    return mode


def indicators(run: Trajectory, burn_in: int = 0) -> dict[str, float]:
    """Key performance indicators of a run.

    They are `Trajectory.means`, `input_effort` and `failures`, the samples under the fallback.

    Args:
        run: its samples.
        burn_in: samples at the start that do not count.
    """
    lower = run.scenario.action_lower
    upper = run.scenario.action_upper
    actions = run.actions[burn_in:]
    failed = run["failed"][burn_in:]
    values = run.means(burn_in)
    values["input_effort"] = input_effort(actions, lower, upper)
    values["failures"] = float(np.sum(failed))
    return values


def measure(
    plant: Plant,
    controller: Controller,
    seed: int,
    steps: int,
    burn_in: int = 0,
    progress: Callable[[int], None] | bool = False,
) -> tuple[dict[str, float], dict[str, float]]:
    """Run a controller on a seed's noise.

    Args:
        plant: what is controlled.
        controller: the feedback law.
        seed: of the noise.
        steps: samples that count.
        burn_in: samples before these.
        progress: as in `simulate`.

    Returns:
        The `indicators`; and times, `wall_time_s` and quantiles of each phase of a sample in µs.
    """
    begin = perf_counter()
    run = simulate(
        plant,
        controller,
        burn_in + steps,
        seed,
        progress=progress,
        residuals=False,
    )
    seconds = perf_counter() - begin
    clock = {"wall_time_s": seconds}
    for phase, quantiles in run.timing_summary().items():
        for name, value in quantiles.items():
            clock[f"{phase}_{name}"] = value
    return indicators(run, burn_in), clock


def indicators_of(
    plant: Plant,
    controller: Controller,
    seeds: Sequence[int],
    steps: int,
    progress: Callable[[int], None] | None = None,
) -> dict[str, Array]:
    """`indicators` of a controller on several seeds.

    Args:
        plant: what is controlled.
        controller: the feedback law.
        seeds: of the noise, S of them.
        steps: samples of each run.
        progress: called each second or so with the samples of all runs so far.

    Returns:
        Values (S,) by name.
    """
    rows = []
    for number, seed in enumerate(seeds):
        before = number * steps
        values, _ = measure(
            plant,
            controller,
            seed,
            steps,
            progress=progress is not None and after(before, progress),
        )
        rows.append(values)
    table = {}
    for name in rows[0]:
        table[name] = np.array([row[name] for row in rows])
    return table


def after(before: int, progress: Callable[[int], None]) -> Callable[[int], None]:
    """The `progress` of a run that follows others.

    Args:
        before: samples of the runs before.
        progress: what is called with the samples of all.
    """
    return lambda samples: progress(before + samples)


def input_effort(
    actions: Array,
    lower: Array,
    upper: Array,
) -> float:
    """Mean over samples of Σᵢ |uᵢ,ₖ − uᵢ,ₖ₋₁| / (u_u − u_l)ᵢ, the share of the range moved.

    Args:
        actions: u, (K, m).
        lower: u_l, (m,).
        upper: u_u, (m,).

    Returns:
        0 for one sample, which moves nothing.
    """
    if len(actions) < 2:
        return 0.0
    moves = np.abs(np.diff(actions, axis=0))
    shares = moves / (upper - lower)
    effort = np.sum(shares, axis=1)
    return float(np.mean(effort))


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
        # Whoever reports need not know whether anybody listens.
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
    shown = rich_progress.Progress(*columns, console=console, auto_refresh=False)
    with shown as bar:
        task = bar.add_task(label, total=total, remark="")
        last_drawn = 0.0

        def update(*news: object) -> None:
            nonlocal last_drawn
            done, remark = read(*news)
            bar.update(task, completed=done, remark=remark)
            now = perf_counter()
            if now - last_drawn >= REFRESH:
                last_drawn = now
                bar.refresh()

        yield update
