"""`train`: one training, from Python or the command line, with log, evaluations, checkpoints."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from functools import reduce
from importlib.metadata import version
from itertools import pairwise
from math import ceil, inf, isfinite, isnan, nan
from operator import add
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from threadpoolctl import threadpool_limits

from controllers import compile_functions
from controllers.estimator import measured
from controllers.factories import build_controller, nmpc, stored_optimum
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.errors import CapabilityError
from cosim.core.files import check_target, staged, write_atomically
from cosim.core.protocols import Array
from cosim.core.result import Result
from cosim.core.run_files import TRAINING_FILES
from cosim.core.scenario import Scenario
from cosim.core.simulation import functions_of, reporting, simulate
from cosim.core.statistics import Estimate, shown
from cosim.core.training_options import (
    CHECKPOINT,
    CHECKPOINT_PAUSE,
    HELD_OUT,
    LOG,
    PARAMETERS,
    TrainingOptions,
    with_training_options,
)
from cosim.plant import FmuPlant
from cosim.plant.fmi import steps_are_fast
from learning import checkpoint
from learning.algorithm import Algorithm, Privilege, Update, load_algorithm
from learning.checkpoint import State, part_of, prefixed
from learning.configuration import Configuration
from learning.errors import CheckpointError, ConfigurationError, DivergenceError
from learning.evaluator import Evaluator, KnownCosts, number_if_known
from learning.log import LOG_COLUMNS, METRICS, LogRow, to_csv
from learning.step import smallest_eigenvalue
from learning.training_run import TrainingRun, begin_training, make_run, most_evaluations
from learning.verdict import NO_DIFFERENCE, NOT_COMPARED, UNCHANGED, WORSE, Verdict, verdict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURE = "learning.png"
REMARKS = {
    "J": "J",
    "greedy_J": "greedy J",
    "regret": "regret",
    "td_error": "TD",
}
"""Columns of the log behind the progress bar, with their text there."""


@dataclass(frozen=True, repr=False)
class Training(Result):
    """A training that has ended.

    Attributes:
        run: what it was.
        learned: the θ that it ended with.
        rows: its log; the first row is of the start, before a sample.
        evaluation: the greedy policy of `learned` on held-out noise (`Evaluator.evaluate`).
        status: `finished` or `diverged: …`.
        requires: `operation` or `simulator`, as the algorithm says.
        plant_samples: taken in all.
        start: the first θ.
        start_J: its greedy J on that noise.
        baselines: J of `naive` and, where known, `optimal` on the same noise.
        n_baselines: number of controllers that were evaluated before the first sample.
        predicted_cost: what the rule expects θ to cost, mean per sample; NaN of a rule without a
            prediction.
        changes: how often the rule has detected that the plant is another one; None where it does
            not look for that.
        functions: whether the controller's were `interpreted` or `compiled`.
        without_checkpoint: why a checkpoint is missing.
        wall_seconds: the time that it took.
    """

    run: TrainingRun
    learned: Parameters
    rows: list[LogRow]
    evaluation: dict[str, Any]
    status: str
    requires: Privilege
    plant_samples: int
    start: Parameters
    start_J: float
    baselines: Mapping[str, float]
    n_baselines: int
    predicted_cost: float = float("nan")
    changes: int | None = None
    functions: str | None = None
    without_checkpoint: str | None = None
    wall_seconds: float = field(default=float("nan"), compare=False)

    def _facts(self) -> dict[str, object]:
        run = self.run
        return {
            "algorithm": run.algorithm,
            "scenario": run.scenario.name,
            "start": run.start,
            "samples": self.plant_samples,
            "seed": run.seed,
            "status": self.status,
            "J of the start": self.start_J,
            "J": self.J,
            "difference": shown(*self.difference, digits=3),
            "verdict": self.verdict,
            "updates": self.updates,
            "predicted cost": self.predicted_cost,
            "realised cost": self.realised_cost,
            "changes detected": self.changes,
            "retreats": self.retreats,
            "regret": self.regret,
        }

    def to_pandas(self) -> Any:
        """The training's log as a pandas data frame."""
        import pandas as pd  # noqa: PLC0415 - half a second

        return pd.DataFrame(self.log())

    @property
    def J(self) -> float:
        """Mean of economic cost and penalty per sample of the greedy policy, on held-out noise."""
        return float(self.evaluation["J"])

    @property
    def difference(self) -> Estimate:
        """J less J of the start on the same noise, with its interval over the seeds."""
        interval = self.evaluation["difference_interval"]
        return Estimate(self.evaluation["difference"], interval)

    @property
    def verdict(self) -> Verdict:
        """Whether the learned θ is shown to be better than the start, or worse."""
        found = NO_DIFFERENCE
        if self.run.evaluation_seeds:
            found = verdict(self.difference)
        # Of equal θ there is no difference to show.
        if found == NO_DIFFERENCE and self._is_unchanged:
            return UNCHANGED
        if not self.run.evaluation_seeds:
            return NOT_COMPARED
        return found

    @property
    def _is_unchanged(self) -> bool:
        """Whether the learned θ is the start's."""
        return np.array_equal(self.learned.theta, self.start.theta)

    @property
    def reason(self) -> str:
        """Why θ is the start's, in words, as far as the log tells; empty where it has moved."""
        if not self._is_unchanged:
            return ""
        if self.status != "finished":
            return "the run ended before θ moved"
        if not self.updates:
            return "the rule made no update: more --samples may give it one"
        n_refused = int(_total(row["refused"] for row in self.rows))
        if n_refused == self.updates:
            return (
                f"all {n_refused} updates were refused, by the rule or by what keeps θ admissible"
            )
        if self.retreats:
            return "θ went back to its start, which was shown to cost less"
        return f"none of {self.updates} updates moved it"

    @property
    def parameters(self) -> Parameters:
        """The θ to use: the learned one, or the start's where that one is worse."""
        return self.start if self.verdict == WORSE else self.learned

    @property
    def updates(self) -> int:
        """Updates of θ in all."""
        return int(_total(row["updates"] for row in self.rows))

    @property
    def retreats(self) -> int:
        """Number of retreats to a θ that was shown to cost less."""
        return int(_total(row["retreats"] for row in self.rows))

    @property
    def held_out_samples(self) -> int:
        """Plant samples of the held-out runs, beside those of the training."""
        run = self.run
        evaluations = self.n_baselines
        theta = self.start.theta
        for row in self.rows[1:]:
            was_evaluated = not isnan(row["greedy_J"])
            # The same θ once more is not run again.
            has_moved = not np.array_equal(row.parameters.theta, theta)
            if was_evaluated and has_moved:
                evaluations += 1
                theta = row.parameters.theta
        return evaluations * run.evaluation_seeds * run.evaluation_steps

    @property
    def realised_cost(self) -> float:
        """Mean cost per sample of the training itself since the last update.

        Of whole intervals of the log; NaN where the last one has an update.
        """
        total = 0.0
        count = 0.0
        # The latest interval first, back to the one that moved θ.
        last_first = list(reversed(self.rows))
        for row, before in pairwise(last_first):
            if row["updates"]:
                break
            samples = row["samples"] - before["samples"]
            total += samples * row["J"]
            count += samples
        return total / count if count else float("nan")

    @property
    def regret(self) -> float:
        """(J − J*)/|J*| on that noise; NaN if J* is unknown."""
        regret = self.evaluation["regret"]
        return float("nan") if regret is None else float(regret)

    def controller(self) -> RtiNmpc:
        """A fresh controller of the state that has the θ to use.

        Where the scenario has sensors, `controllers.OutputFeedback` puts the estimator before it.
        """
        return nmpc(self.run.scenario, self.parameters, self.run.controller)

    def log(self) -> dict[str, Array]:
        """The columns of the training's log, (K,) each, NaN where not measured."""
        columns = {}
        for name in self.rows[0]:
            values = [row[name] for row in self.rows]
            columns[name] = np.array(values)
        return columns

    def theta(self) -> dict[str, Array]:
        """Increments of θ since the start by block, (K, entries) each."""
        thetas = np.array([row.parameters.theta for row in self.rows])
        moved = thetas - self.start.theta
        slices = self.parameters.blocks.slices
        return {name: moved[:, where] for name, where in slices.items()}

    def figure(self, width: float | None = None) -> Figure:
        """Cost, violations, TD error and θ over the samples.

        Args:
            width: in inches; by default that of two columns of a journal.
        """
        from cosim.figures.style import WIDTH  # noqa: PLC0415 - matplotlib
        from cosim.figures.training import training_figure  # noqa: PLC0415

        run = self.run
        blocks = self.parameters.blocks
        # Each entry of θ in units of its own scale.
        scaled = {}
        for name, values in self.theta().items():
            scale = blocks.scale[blocks.slices[name]]
            scaled[name] = values / scale
        # A title has no room for the reason.
        end, _, _ = self.status.partition(":")
        return training_figure(
            self.log(),
            scaled,
            self.baselines,
            title=f"{run.algorithm} ({self.requires}) on {run.scenario.name} from "
            f"{Path(run.start).stem}, seed {run.seed}: {end}, {self.verdict}. "
            f"J = {shown(self.J, digits=6)}, of the start {shown(self.start_J, digits=6)}, "
            f"difference {shown(*self.difference, digits=3)}",
            width=width or WIDTH,
        )

    def animate(
        self,
        path: str | Path,
        steps: int = 200,
        frames: int = 40,
    ) -> Path:
        """Write a GIF of the closed loop with θ as it was learned, over that of the start.

        A frame for each of some rows of the log, on noise that no training met.

        Args:
            path: of the GIF.
            steps: samples of a closed loop.
            frames: at most.

        Raises:
            FigureError: nothing can be drawn.
            OSError: the file cannot be written.
        """
        from cosim.figures.trajectory import animation  # noqa: PLC0415 - matplotlib

        run = self.run
        policy = nmpc(run.scenario, self.start, run.controller)
        # Trainings have the seeds below HELD_OUT, evaluations those from there on.
        seed = 2 * HELD_OUT + run.seed
        # The start is in every frame already.
        rows = self.rows[1:]
        every = ceil(len(rows) / frames)
        start_name = Path(run.start).stem
        runs = {}
        with FmuPlant(run.scenario) as plant:
            law = measured(run.scenario, policy)
            first = simulate(plant, law, steps, seed)
            for row in rows[::every]:
                policy.theta = row.parameters.theta
                title = f"after {row['samples']:.0f} samples"
                runs[title] = simulate(plant, law, steps, seed)
        return animation(start_name, first, run.algorithm, runs, path)

    def save(self, folder: str | Path) -> Path:
        """Write parameters.toml, learning.csv, learning.png and scenario.toml; the folder."""
        with staged(folder) as stage:
            self.write_files(stage)
        return Path(folder)

    def write_files(self, folder: Path) -> None:
        """Write the files of `save` one after the other."""
        write_atomically(folder / LOG, to_csv(self.rows))
        self.parameters.save(folder / PARAMETERS)
        write_atomically(folder / "scenario.toml", self.run.scenario.to_toml())
        self.plot(folder / FIGURE)

    def summary(self) -> dict[str, Any]:
        """The training as a JSON document: settings, the greedy policy's metrics, how it ended."""
        run = self.run
        last = self.rows[-1]
        return {
            "version": version("rti-cosim"),
            "algorithm": run.algorithm,
            "requires": self.requires,
            "scenario": run.scenario.name,
            "scenario_hash": run.scenario.hash,
            "controller": run.controller,
            "start": run.start,
            "samples": int(last["samples"]),
            "plant_samples": self.plant_samples,
            "held_out_samples": self.held_out_samples,
            "seed": run.seed,
            "status": self.status,
            "hyperparameters": run.configuration.model_dump(mode="json"),
            "verdict": self.verdict,
            "reason": self.reason or None,
            "updates": self.updates,
            "predicted_cost": number_if_known(self.predicted_cost),
            "realised_cost": number_if_known(self.realised_cost),
            "changes": self.changes,
            "retreats": self.retreats,
            "parameters_hash": self.parameters.hash,
            "evaluation_seeds": run.evaluation_seeds,
            "evaluation_steps": run.evaluation_steps,
            "start_J": self.start_J,
            **self.evaluation,
            "smallest_eigenvalue": last["smallest_eigenvalue"],
            "td_error": last["td_error"],
            "training_failures": int(last["failures"]),
            "weakly_active": int(last["weakly_active"]),
            "licq_failed": int(last["licq_failed"]),
        }


class Tracker(Protocol):
    """An object that follows a training as `progress` of `train`; a function will do, too."""

    def start(self, run: TrainingRun) -> None:
        """Note the run, before its first sample."""

    def __call__(self, samples: int, row: LogRow) -> None:
        """Note a row of the log.

        Args:
            samples: done so far.
            row: the log's last one.
        """

    def end(self, training: Training) -> None:
        """Note the result, finished or diverged."""


@with_training_options()
def train(
    algorithm: str,
    scenario: Scenario | str | Path = "paper",
    samples: int | None = None,
    *,
    settings: Mapping[str, Any] | Configuration | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[int, LogRow], None] | bool = False,
    **options: Any,
) -> Training:
    """Train a controller's θ on a scenario's plant; J* is that of its stored optimum, if any.

    Raises AlgorithmLookupError, ConfigurationError, ScenarioError, PlantError, CheckpointError,
    each in one line, before the work where that is possible; PrivilegeError where an algorithm asks
    more of the plant than it requires.

    Args:
        algorithm: a registered name (`learning.algorithm.algorithms`) or `module:Class`.
        scenario: a scenario, a preset's name or a TOML file.
        samples: plant samples; None: the algorithm's budget, else 50 000.
        settings: hyperparameters by name; the algorithm's Configuration documents them.
        out: folder of the run's checkpoints; None keeps none. `Training.save` writes the rest.
        resume: go on from the checkpoint in `out`.
        progress: a function of the samples done and the log's last row, or a `Tracker`; True draws
            a bar.
        options: fields of `TrainingOptions` by name: seed, start, evaluate_every, ….
    """
    if not isinstance(scenario, Scenario):
        scenario = Scenario.load(scenario)
    if isinstance(options.get("start"), Path):
        # The run's identity is JSON, which has no paths.
        options["start"] = str(options["start"])
    run = make_run(algorithm, scenario, samples, settings, TrainingOptions(**options))
    # Regret needs J*, which is solved for once and stored.
    optimum = stored_optimum(scenario)
    return run_training(
        run,
        out,
        resume=resume,
        optimum=optimum,
        progress=progress,
    )


def run_training(
    run: TrainingRun,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    optimum: str | None = None,
    progress: Callable[[int, LogRow], None] | bool = False,
    rule: type[Algorithm] | None = None,
    known: KnownCosts | None = None,
) -> Training:
    """Train as `run` says.

    With `out`, learning.csv, parameters.toml and checkpoint.npz are kept there during the run; a
    plant that cannot serialise its state leaves no checkpoint. Log, evaluations and files are of
    the final θ so far. Errors are those of `train`.

    Args:
        run: the run.
        out: folder of its files; None keeps none.
        resume: go on from the checkpoint in `out`.
        optimum: controller whose J is J*; without it regret and gap closed are unknown.
        progress: as in `train`.
        rule: the algorithm's class where it is not to be looked up by its name.
        known: costs that runs of one process have in common, as in `Evaluator`.
    """
    clock = time.perf_counter()
    if hasattr(progress, "start"):
        progress.start(run)
    best = build_controller(optimum, run.scenario) if optimum else None
    folder = None if out is None else Path(out)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        # Before the work: a folder that cannot be written costs no run.
        for name in (LOG, PARAMETERS, CHECKPOINT):
            check_target(folder / name)
    with (
        # The rules' matrices are small: a second thread of BLAS spins for longer than it computes,
        # and a model-based training took twice its processor time.
        threadpool_limits(limits=1, user_api="blas"),
        # Two plants: an evaluation must not touch the one that is learned from.
        FmuPlant(run.scenario) as plant,
        FmuPlant(run.scenario) as evaluation_plant,
    ):
        session = _Session(run, rule or load_algorithm(run.algorithm), plant, folder)
        compile_functions(session.loop.law, run.samples)
        if resume:
            session.load()
        else:
            # Without a folder, too: it restarts the solver, and no digit may depend on a folder.
            session.checkpoint()
        # A function of the user's gets the rows of the log. A bar moves between them, and over the
        # held-out runs, too.
        is_bar = progress is True
        total = run.samples
        if is_bar and run.evaluation_seeds:
            evaluations = most_evaluations(run.samples, run.evaluate_every)
            total += evaluations * run.evaluation_seeds * run.evaluation_steps
        with reporting(progress, run.algorithm, total, _Remark()) as report:

            def show_held_out(samples: int) -> None:
                report(session.loop.counts.number + samples, {})

            evaluator = Evaluator(
                run,
                evaluation_plant,
                session.start,
                best,
                known,
                show_held_out if is_bar else None,
            )

            def show(samples: int, row: LogRow) -> None:
                report(samples + evaluator.samples, row)

            status = session.run_to_the_end(evaluator, show if is_bar else report, between=is_bar)
            # Held-out runs of the same θ were left out.
            if is_bar:
                report(total, session.rows[-1])
        learned = session.loop.parameters
        training = Training(
            run=run,
            learned=learned,
            rows=session.rows,
            evaluation=evaluator.evaluate(learned.theta),
            status=status,
            requires=session.loop.algorithm.requires,
            plant_samples=session.loop.counts.number,
            start=session.start,
            start_J=evaluator.start["J"],
            baselines=evaluator.baselines,
            n_baselines=evaluator.n_baselines,
            predicted_cost=float(getattr(session.loop.algorithm, "predicted_cost", nan)),
            changes=getattr(session.loop.algorithm, "changes", None),
            functions=functions_of(session.loop.law),
            without_checkpoint=session.without_checkpoint,
            wall_seconds=time.perf_counter() - clock,
        )
    # The checkpoint's file has the θ that the run ended with.
    if folder is not None and training.verdict == WORSE:
        training.parameters.save(folder / PARAMETERS)
    if hasattr(progress, "end"):
        progress.end(training)
    return training


class _Remark(dict[str, float]):
    """The last value of each column of the log, and the remark behind a bar made of them."""

    def __call__(self, done: int, row: Mapping[str, float]) -> tuple[int, str]:
        # What a row does not measure stays as it was measured last.
        for name, value in row.items():
            if not isnan(value):
                self[name] = value
        words = []
        for name, text in REMARKS.items():
            if name in self:
                words.append(f"{text} {self[name]:.4g}")
        return done, "  ".join(words)


class _Session:
    """A run in progress: its loop, its log so far, and its checkpoint."""

    def __init__(
        self,
        run: TrainingRun,
        algorithm: type[Algorithm],
        plant: FmuPlant,
        out: Path | None,
    ) -> None:
        self.run = run
        self.plant = plant
        self.out = out
        self.identity = run.identity()
        self.loop = begin_training(run, algorithm, plant)
        self.start = self.loop.start_parameters
        self.rows: list[LogRow] = []
        # Since the last row:
        self.costs: list[float] = []
        self.updates: list[Update] = []
        self.without_checkpoint: str | None = None
        self._quiet_until = 0.0

    def run_to_the_end(
        self,
        evaluator: Evaluator,
        progress: Callable[[int, LogRow], None],
        between: bool = False,
    ) -> str:
        """Take all samples, with log, evaluations and checkpoints.

        Args:
            evaluator: of θ on held-out noise.
            progress: gets the samples done and the log's last row.
            between: whether it is called between the rows, too, each second.

        Returns:
            `finished` or `diverged: …`.
        """
        reported_at = time.perf_counter()
        run = self.run
        number = self.loop.counts.number
        if not self.rows:
            self.rows.append(self.first_row(evaluator))
        while number < run.samples:
            try:
                cost, update = self.loop.advance()
            except DivergenceError as error:
                self.rows.append(self.row(number + 1, evaluator))
                return f"diverged: {error} at sample {number + 1}"
            number += 1
            self.costs.append(cost)
            if update is not None:
                self.updates.append(update)
            # The last sample has a row, an evaluation and a checkpoint in any case.
            last = number == run.samples
            if number % run.log_every and not last:
                if between and time.perf_counter() - reported_at > 1.0:
                    reported_at = time.perf_counter()
                    progress(number, self.rows[-1])
                continue
            evaluated = last or number % run.evaluate_every == 0
            row = self.row(number, evaluator if evaluated else None)
            self.rows.append(row)
            divergence = self.divergence(row, evaluator)
            if divergence is not None:
                return divergence
            if last or number % run.checkpoint_every == 0:
                self.checkpoint(is_last=last)
            progress(number, row)
        return "finished"

    def first_row(self, evaluator: Evaluator) -> LogRow:
        """The line of the log before the first sample: the start, evaluated."""
        start = self.start
        metrics = dict.fromkeys(LOG_COLUMNS, float("nan"))
        # Nothing has happened yet: all that is counted is zero.
        counts = dict.fromkeys(asdict(self.loop.counts), 0)
        counts.pop("number")
        metrics |= counts
        for name in ("samples", "plant_samples", "updates", "corrected", "refused", "retreats"):
            metrics[name] = 0
        metrics["smallest_eigenvalue"] = smallest_eigenvalue(start.blocks, start.theta)
        metrics |= _greedy(evaluator.start)
        return LogRow(metrics, start)

    def row(self, number: int, evaluator: Evaluator | None) -> LogRow:
        """A line of the log since the last one, with an evaluation where there is an evaluator."""
        parameters = self.loop.parameters
        updates = self.updates
        # Of no update there is no mean.
        n_updates = len(updates) or float("nan")
        n_costs = len(self.costs) or float("nan")
        mean_cost = _total(self.costs) / n_costs
        mean_square = _total(update.td_error**2 for update in updates) / n_updates
        mean_step = _total(update.step for update in updates) / n_updates
        # Of all θ since the last row, whichever step gave it.
        smallest = smallest_eigenvalue(parameters.blocks, parameters.theta)
        for update in updates:
            smallest = min(update.smallest_eigenvalue, smallest)
        counts = asdict(self.loop.counts)
        metrics = dict.fromkeys(LOG_COLUMNS, float("nan"))
        metrics["samples"] = number
        metrics["updates"] = len(updates)
        metrics["J"] = mean_cost
        metrics["td_error"] = mean_square**0.5
        metrics["step"] = mean_step
        metrics["smallest_eigenvalue"] = smallest
        metrics["corrected"] = sum(update.corrected for update in updates)
        metrics["refused"] = sum(update.refused for update in updates)
        metrics["retreats"] = sum(update.retreated for update in updates)
        metrics["plant_samples"] = counts.pop("number")
        metrics |= counts
        self.costs = []
        self.updates = []
        if evaluator is not None:
            evaluation = evaluator.evaluate(parameters.theta)
            metrics |= _greedy(evaluation)
        return LogRow(metrics, parameters)

    def divergence(self, row: LogRow, evaluator: Evaluator) -> str | None:
        """Why the run must stop, or None: two evaluations in a row, or the last, are too high."""
        greedy = row["greedy_J"]
        limit = evaluator.limit
        # Not NaN, where nothing was evaluated, nor infinite.
        if not limit < greedy < inf:
            return None
        # The start's own evaluation says nothing of learning.
        costs = [other["greedy_J"] for other in self.rows[1:]]
        evaluations = [cost for cost in costs if isfinite(cost)]
        # One bad evaluation may be noise, two are not.
        is_first_bad_one = len(evaluations) < 2 or evaluations[-2] <= limit
        goes_on = row["samples"] < self.run.samples
        if is_first_bad_one and goes_on:
            return None
        reason = f"greedy J = {shown(greedy)} exceeds {shown(limit)}"
        return f"diverged: {reason} at sample {int(row['samples'])}"

    def checkpoint(self, *, is_last: bool = False) -> None:
        """Start the solver afresh, as a resumed run will, and write the files of the run so far.

        Args:
            is_last: whether the run ends here. Before that the files of another's FMU, whose
                checkpoints are close, wait until those before are a while old.
        """
        self.loop.restart()
        if self.out is None:
            return
        begin = time.perf_counter()
        is_fast = steps_are_fast(self.run.scenario.plant.fmu)
        if begin < self._quiet_until and not (is_fast or is_last):
            return
        # Nothing of another run may stay beside the files of this one.
        with staged(self.out, TRAINING_FILES) as stage:
            write_atomically(stage / LOG, to_csv(self.rows))
            self.loop.parameters.save(stage / PARAMETERS)
            self._save_state(stage / CHECKPOINT)
        end = time.perf_counter()
        self._quiet_until = end + CHECKPOINT_PAUSE * (end - begin)

    def _save_state(self, path: Path) -> None:
        """Write what resuming needs, where the plant can say its state."""
        try:
            plant = self.plant.serialise(self.plant.snapshot())
        except CapabilityError as error:
            self.without_checkpoint = str(error)
            return
        # All that the rest of the run depends on, the log included.
        metrics = [list(row.values()) for row in self.rows]
        thetas = [row.parameters.theta for row in self.rows]
        state = prefixed("loop", self.loop.state_dict())
        state["plant"] = np.frombuffer(plant, np.uint8)
        state["rows"] = np.array(metrics, float)
        state["row_thetas"] = np.array(thetas)
        checkpoint.save(path, self.identity, state)

    def load(self) -> None:
        """Load the folder's checkpoint; raises CheckpointError if none fits."""
        if self.out is None:
            raise ConfigurationError("a run without a folder cannot be resumed")
        path = self.out / CHECKPOINT
        state = checkpoint.load(path, self.identity)
        try:
            self._restore(state)
        except Exception as error:  # whatever arrays of other names, shapes or kinds lead to
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise CheckpointError(
                f"{path}: the checkpoint does not hold the state of this run ({reason}); begin "
                "anew by --overwrite"
            ) from error

    def _restore(self, state: State) -> None:
        """Put log, plant and loop back as a checkpoint has them."""
        metrics_of_rows = state["rows"].tolist()
        theta_of_rows = state["row_thetas"]
        self.rows = []
        for values, theta in zip(metrics_of_rows, theta_of_rows, strict=True):
            metrics = dict(zip(LOG_COLUMNS, values, strict=True))
            parameters = self.start.with_theta(theta)
            row = LogRow(metrics, parameters)
            self.rows.append(row)
        snapshot = self.plant.deserialise(state["plant"].tobytes())
        self.plant.restore(snapshot)
        # The loop last: it reads the plant's state.
        self.loop.load_state_dict(part_of(state, "loop"))


def _greedy(evaluation: Mapping[str, Any]) -> dict[str, float]:
    """Columns of the log that an evaluation fills, NaN where it knows nothing."""
    columns = {f"greedy_{name}": evaluation[name] for name in METRICS}
    for name in ("regret", "gap_closed"):
        value = evaluation[name]
        columns[name] = float("nan") if value is None else value
    return columns


def _total(values: Iterable[float]) -> float:
    """The sum, in the order of the values: `sum` compensates for rounding in some versions."""
    return reduce(add, values, 0.0)
