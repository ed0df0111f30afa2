"""`train`: one training, from Python or the command line: settings, start, log and judge."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import reduce
from importlib.metadata import version
from math import gcd, inf, isfinite, isnan
from numbers import Integral, Real
from operator import add
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from controllers import compile_functions
from controllers.economic import tune
from controllers.factories import nmpc
from controllers.optimum import stored_optimum
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters, ThetaBlocks
from cosim.errors import CapabilityError
from cosim.files import check_target, staged, write_atomically
from cosim.identity import depends_on
from cosim.plant import FmuPlant
from cosim.plugins import build_controller
from cosim.protocols import Array, Controller, Plant
from cosim.result import Result, csv_text
from cosim.scenario import Scenario
from cosim.simulation import functions_of, indicators_of, reporting, simulate, spawn_seeds
from cosim.statistics import gap_closed, regret, shown
from cosim.validation import suggestion
from learning import checkpoint
from learning.algorithm import Algorithm, Privilege, Strategy, TrainingLoop, Update, load_algorithm
from learning.commissioning import back_off, spare
from learning.configuration import Configuration
from learning.errors import CheckpointError, ConfigurationError, DivergenceError
from learning.step import smallest_eigenvalue

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SAMPLES = 50_000
"""Length of a run where neither user nor algorithm states one."""
STARTS = ("naive", "tuned", "commissioned", "cautious")
FRAMES = 40
"""Most frames of an animation."""
SHOWN = {"J": "J", "greedy_J": "greedy J", "regret": "regret", "td_error": "TD"}
"""Columns of the log behind the progress bar, with their text there."""
EVERY = ("log_every", "evaluate_every", "checkpoint_every")
LEAST = {"seed": 0} | dict.fromkeys(
    ("samples", *EVERY, "evaluation_seeds", "evaluation_steps", "rest_after"), 1
)


@dataclass(frozen=True)
class TrainingRun:
    """The identity of a training run; only an identical one can resume a checkpoint.

    The `configuration` is completed by what the `scenario` states. `controller`, `rti` or
    `converged`, carries θ. A row of the log comes every `log_every` samples, a greedy evaluation of
    θ every `evaluate_every`, on `evaluation_seeds` held-out seeds of `evaluation_steps` samples, a
    checkpoint every `checkpoint_every`. After `rest_after` samples θ stays and nothing explores. A
    run has diverged, and ends, where its greedy J exceeds the larger of the naive θ's and the
    start's by more than (`divergence` − 1) of its magnitude, twice in a row or at the end. Raises
    ConfigurationError on counts that make no run.
    """

    algorithm: str
    scenario: Scenario
    samples: int
    seed: int
    configuration: Configuration
    controller: str = "rti"
    log_every: int = 1000
    evaluate_every: int = 5000
    checkpoint_every: int = 5000
    evaluation_seeds: int = 4
    evaluation_steps: int = 500
    divergence: float = 1.5
    start: str = "naive"
    rest_after: int | None = None

    def __post_init__(self) -> None:
        completed = self.configuration.for_scenario(self.scenario)
        object.__setattr__(self, "configuration", completed)
        for name, least in LEAST.items():
            if (value := getattr(self, name)) is not None and value < least:
                raise ConfigurationError(f"{name} must be at least {least}, not {value}")
        if self.seed >= HELD_OUT:
            raise ConfigurationError(
                f"seed must be below {HELD_OUT}, not {self.seed}: the noise from there on is held "
                "out, to evaluate what was learned"
            )
        for name in EVERY[1:]:
            if getattr(self, name) % self.log_every:
                raise ConfigurationError(
                    f"{name} = {getattr(self, name)} must be a multiple of log_every = "
                    f"{self.log_every}"
                )

    def identity(self) -> dict[str, Any]:
        """The run as JSON-ready values, with the hashes of all code that its result depends on."""
        values = {option.name: getattr(self, option.name) for option in fields(self)}
        values["scenario"] = self.scenario.hash
        values["configuration"] = self.configuration.model_dump(mode="json")
        if (file := Path(self.start)).is_file():
            values["start"] = hashlib.sha256(file.read_bytes()).hexdigest()[:16]
        values["source"] = depends_on(self.scenario, self.algorithm)
        return values

    def starting_parameters(self) -> Parameters:
        """θ where the run starts; raises what the function `starting_parameters` raises."""
        problem = Problem.from_scenario(self.scenario)
        if self.start not in ("commissioned", "cautious"):
            return starting_parameters(problem, self.configuration, self.start)
        tuned = starting_parameters(problem, self.configuration, "tuned")
        found = back_off(tuned, self.scenario)
        return found if self.start == "commissioned" else spare(found, self.scenario)


OPTIONS = {option.name for option in fields(TrainingRun)[3:]} - {"configuration"}
"""Fields of `TrainingRun` that are options of `train` and of the command by their own names."""


def prepare(
    algorithm: str,
    scenario: Scenario,
    samples: int | None,
    settings: Mapping[str, Any] | Configuration | None,
    options: Mapping[str, Any],
) -> TrainingRun:
    """The run of an algorithm by name, checked; `options` are the other fields of `TrainingRun`.

    Raises AlgorithmLookupError; ConfigurationError on settings or options that make no run.
    """
    found = load_algorithm(algorithm)
    for name in options:
        if name not in OPTIONS:
            raise ConfigurationError(f"training has no option '{name}'{suggestion(name, OPTIONS)}")
    _check_kinds({"samples": samples, **options})
    if settings is not None and not isinstance(settings, Configuration | Mapping):
        raise ConfigurationError(f"settings must be a table, not a {type(settings).__name__}")
    if not isinstance(settings, Configuration):
        settings = found.Configuration.from_dict(dict(settings or {}))
    # Intervals that are not given are near their defaults and fit the others.
    given = {name: value for name in EVERY if (value := options.get(name)) is not None}
    together = gcd(*(given[name] for name in EVERY[1:] if name in given))
    most = TrainingRun.log_every
    log = given.get("log_every", next(k for k in range(most, 0, -1) if together % k == 0))
    rows = max(1, round(TrainingRun.evaluate_every / max(1, log)))
    return TrainingRun(
        algorithm=algorithm,
        scenario=scenario,
        samples=getattr(found, "budget", SAMPLES) if samples is None else samples,
        configuration=settings,
        **{**options, **dict.fromkeys(EVERY[1:], rows * log), "log_every": log, **given},
    )


def _check_kinds(options: Mapping[str, Any]) -> None:
    """Refuse options of another kind than the fields of `TrainingRun` by ConfigurationError."""
    optional = {"samples", "rest_after", *EVERY}
    for name, value in options.items():
        if value is None and name in optional:
            continue
        kind: type = Integral if name in LEAST else Real if name == "divergence" else str
        if not isinstance(value, kind) or isinstance(value, bool):
            words = "a text" if kind is str else "a number" if kind is Real else "a whole number"
            raise ConfigurationError(f"training: {name} must be {words}, not {value!r:.60}")
    margin, carrier = options.get("divergence", 1.0), options.get("controller", "rti")
    if not margin >= 1.0 or margin == inf:
        raise ConfigurationError(f"training: divergence must be at least 1, not {margin}")
    if carrier not in ("rti", "converged"):
        raise ConfigurationError(
            f"training: there is no controller '{carrier}'; there are rti and converged"
        )


def begin(run: TrainingRun, algorithm: type[Algorithm], plant: FmuPlant) -> TrainingLoop:
    """The loop of a run at its start: the plant is reset, once, and the first state is solved for.

    All random numbers come from the run's seed.
    """
    controller = nmpc(run.scenario, run.starting_parameters(), run.controller)
    strategy = Strategy(run.configuration, run.scenario)
    plant_seed, rng = spawn_seeds(run.seed)
    # The third child of the run's seed sequence; `spawn_seeds` takes the first two.
    own = np.random.default_rng(np.random.SeedSequence(run.seed).spawn(3)[2])
    rule = algorithm(controller, run.scenario, run.configuration, run.samples, strategy, own)
    loop = TrainingLoop(plant, controller, rule, strategy, rng, run.rest_after, own)
    if (first := getattr(rule, "first_episode", None)) is not None:
        plant, plant_seed = loop.simulator("first_episode"), first
    loop.start(plant.reset(plant_seed))
    return loop


def starting_parameters(
    problem: Problem, configuration: Configuration, start: str = "naive"
) -> Parameters:
    """θ at the start: the paper's naive one, the economically tuned one, or that of a file.

    `start` is `naive`, `tuned` or the path of a parameters file. `naive` and `tuned` take c_lambda
    from the configuration; blocks that a file lacks start as with `naive`. Raises
    ConfigurationError where the file has slack weights and the parametrisation none, ParameterError
    on a bad file, TuningError where the tuning fails.
    """
    if not Path(start).exists() and (meant := suggestion(start, STARTS)) and start not in STARTS:
        raise ConfigurationError(f"there is no start '{start}'{meant}, nor such a parameters file")
    file = None if start in ("naive", "tuned") else Parameters.load(start, problem)
    if file is not None and "w_sigma" in file.blocks and configuration.parametrisation == "paper":
        raise ConfigurationError(
            f"{start}: θ has slack weights, which the parametrisation 'paper' has not; set "
            "parametrisation=extended"
        )
    learned = configuration.learned_parameters(problem.model)
    given = file.blocks.block("p").labels if file is not None and "p" in file.blocks else ()
    blocks = ThetaBlocks.of(
        problem,
        slack_weights=configuration.parametrisation == "extended",
        model_parameters=(*given, *(name for name in learned if name not in given)),
    )
    # The level of V is that of the TD error's discount.
    chosen: float | None = getattr(configuration, "discount", None)
    discounted = configuration.value_offset == "discounted"
    tuned = start == "tuned"
    found = tune(problem, blocks).parameters if tuned else Parameters.naive(problem, blocks)
    if discounted:
        found = found.replace({"c_lambda": problem.value_level(chosen)})
    names = [name for name in ("w_sigma", "W_sigma") if name in blocks]
    found = found.replace({name: blocks.scale[blocks.slices[name]] for name in names})
    return found if file is None else file.placed_in(found)


CHECKPOINT, FIGURE = "checkpoint.npz", "learning.png"
LOG, PARAMETERS = "learning.csv", "parameters.toml"
FILES = (
    CHECKPOINT, LOG, PARAMETERS, FIGURE, "learning.gif", "summary.json", "scenario.toml",
    "training.rrd",
)  # fmt: skip
"""Files of a training; all in a folder belong to one run."""
HELD_OUT = 1_000_000
"""First of the held-out seeds; training seeds stay below."""
FIGURES = ("economic_cost", "mean_violation", "violating_share", "J", "failures")
COLUMNS = (
    "samples", "updates", "J", "td_error", "step", "smallest_eigenvalue", "corrected", "refused",
    "failures", "explored", "saturated", "weakly_active", "licq_failed", "plant_samples",
    "greedy_J", "greedy_economic_cost", "greedy_mean_violation", "greedy_violating_share",
    "greedy_failures", "regret", "gap_closed",
)  # fmt: skip


class LogRow(dict[str, float]):
    """A line of the log: figures by column, NaN where not measured, and the `parameters` then.

    Only the CSV names the entries of θ.
    """

    __slots__ = ("parameters",)

    def __init__(self, figures: Mapping[str, float], parameters: Parameters) -> None:
        super().__init__(figures)
        self.parameters = parameters


def to_csv(rows: Sequence[LogRow]) -> str:
    """The log as CSV: its figures, empty where not measured, and a column `theta NAME` an entry."""
    if not rows:
        return ""
    labels = [f"theta {label}" for label in rows[0].parameters.blocks.labels]
    return csv_text(
        [*rows[0], *labels],
        (map(_cell, [*row.values(), *row.parameters.theta.tolist()]) for row in rows),
    )


def _cell(value: float) -> str:
    if isnan(value):
        return ""
    whole = isfinite(value) and value == int(value)  # the cost of a diverged run is infinite
    return repr(int(value) if whole else value)


def _total(values: Iterable[float]) -> float:
    """The sum, in the order of the values: `sum` compensates for rounding in some versions."""
    return reduce(add, values, 0.0)


class Judge:
    """Judges a run's θ by its greedy policy on the held-out seeds.

    `start` is a θ of the run's blocks. J of the controller `optimum` on the same seeds is J*.
    """

    def __init__(
        self, run: TrainingRun, plant: Plant, start: Parameters, optimum: Controller | None
    ) -> None:
        self._run, self._plant = run, plant
        self._controller = nmpc(run.scenario, start, run.controller)
        naive = Parameters.naive(Problem.from_scenario(run.scenario))
        self._naive_cost = self._costs(nmpc(run.scenario, naive, run.controller))["J"]
        self._optimal_cost = np.full(run.evaluation_seeds, np.nan)
        self.start_J = float(self._costs(self._controller)["J"].mean())
        """J of θ where the run starts."""
        self.baselines = {"naive": float(self._naive_cost.mean())}
        """J of naive and, where it is known, optimal."""
        if optimum is not None:
            self._optimal_cost = self._costs(optimum)["J"]
            self.baselines["optimal"] = float(self._optimal_cost.mean())
        # A cost may be negative (a profit): the margin is a share of its magnitude.
        worst = max(self.baselines["naive"], self.start_J)
        self.limit = worst + (run.divergence - 1) * abs(worst)
        """Greedy J above which a run has diverged."""

    def verdict(self, theta: Array) -> dict[str, Any]:
        """The greedy policy at θ (n_θ,): means of `FIGURES`, `regret`, `gap_closed`.

        `regret_interval` is its 95 % interval over the runs; `failures` is a sum; None is unknown.
        """
        self._controller.theta = theta
        costs = self._costs(self._controller)
        means: dict[str, Any] = {name: float(costs[name].mean()) for name in FIGURES}
        beyond = regret(costs["J"], self._optimal_cost)
        gap = gap_closed(costs["J"], self._naive_cost, self._optimal_cost).value
        known = isfinite(beyond.value)
        return means | {
            "failures": int(costs["failures"].sum()),
            "regret": beyond.value if known else None,
            "regret_interval": beyond.interval,
            "gap_closed": gap if known else None,
        }

    def _costs(self, policy: Controller) -> dict[str, Array]:
        """Indicators of a controller on the held-out seeds."""
        seeds = range(HELD_OUT, HELD_OUT + self._run.evaluation_seeds)
        compile_functions(policy, self._run.evaluation_steps * len(seeds))
        return indicators_of(self._plant, policy, seeds, self._run.evaluation_steps)


@dataclass(frozen=True, repr=False)
class Training(Result):
    """A training that has ended.

    `parameters` are θ as the run hands it over, `rows` its log. `evaluation` is the greedy policy
    on held-out noise (`Judge.verdict`), `start` the first θ and `start_J` its greedy J, `baselines`
    J of `naive` and, where known, `optimal` on the same noise. `status` is `finished` or
    `diverged: …`; `asks_for` the privilege of the algorithm. `functions` says whether the
    controller's were `interpreted` or `compiled`; `without_checkpoint` why a checkpoint is missing.
    """

    run: TrainingRun
    parameters: Parameters
    rows: list[LogRow]
    evaluation: dict[str, Any]
    status: str
    asks_for: Privilege
    plant_samples: int
    start: Parameters
    start_J: float
    baselines: Mapping[str, float]
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
            "J": self.J,
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
    def regret(self) -> float:
        """(J − J*)/|J*| on that noise; NaN if J* is unknown."""
        found = self.evaluation["regret"]
        return float("nan") if found is None else float(found)

    def controller(self) -> RtiNmpc:
        """A fresh controller that has this θ."""
        return nmpc(self.run.scenario, self.parameters, self.run.controller)

    def log(self) -> dict[str, Array]:
        """The columns of the training's log, (K,) each, NaN where not measured."""
        return {name: np.array([row[name] for row in self.rows]) for name in self.rows[0]}

    def theta(self) -> dict[str, Array]:
        """Increments of θ since the start by block, (K, entries) each."""
        moved = np.array([row.parameters.theta - self.start.theta for row in self.rows])
        return {name: moved[:, where] for name, where in self.parameters.blocks.slices.items()}

    def figure(self) -> Figure:
        """Cost, violations, TD error and θ over the samples."""
        from cosim.figures.training import training_figure  # noqa: PLC0415 - matplotlib

        blocks, run = self.parameters.blocks, self.run
        scale = {name: blocks.scale[where] for name, where in blocks.slices.items()}
        greedy, end = shown(self.J, digits=6), self.status.partition(":")[0]
        return training_figure(
            self.log(),
            {name: values / scale[name] for name, values in self.theta().items()},
            self.baselines,
            start=self.start_J,
            title=f"{run.algorithm} ({self.asks_for}) on {run.scenario.name} from "
            f"{Path(run.start).stem}, seed {run.seed}: {end}, J = {greedy}",
        )

    def animate(self, path: str | Path, steps: int = 200) -> Path:
        """Write a GIF of the closed loop with θ as it was learnt, over that of the start.

        A frame for each of at most 40 rows of the log, on noise that no training met. Raises
        FigureError, or OSError where the file cannot be written.
        """
        from cosim.figures.trajectory import animation  # noqa: PLC0415 - matplotlib

        policy, runs = nmpc(self.run.scenario, self.start, self.run.controller), {}
        seed = 2 * HELD_OUT + self.run.seed
        with FmuPlant(self.run.scenario) as plant:
            first = simulate(plant, policy, steps, seed)
            for row in self.rows[:: -(-len(self.rows) // FRAMES)]:
                policy.theta = row.parameters.theta
                title = f"after {row['samples']:.0f} samples"
                runs[title] = simulate(plant, policy, steps, seed)
        return animation(Path(self.run.start).stem, first, self.run.algorithm, runs, path)

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
        """The training as a JSON document: settings, the greedy policy's figures, how it ended."""
        run = self.run
        last = self.rows[-1]
        return {
            "version": version("rti-cosim"),
            "algorithm": run.algorithm,
            "asks_for": self.asks_for,
            "scenario": run.scenario.name,
            "scenario_hash": run.scenario.hash,
            "controller": run.controller,
            "start": run.start,
            "samples": int(last["samples"]),
            "plant_samples": self.plant_samples,
            "seed": run.seed,
            "status": self.status,
            "hyperparameters": run.configuration.model_dump(mode="json"),
            "parameters_hash": self.parameters.hash,
            "evaluation_seeds": run.evaluation_seeds,
            "evaluation_steps": run.evaluation_steps,
            **self.evaluation,
            "smallest_eigenvalue": last["smallest_eigenvalue"],
            "td_error": last["td_error"],
            "training_failures": last["failures"],
            "weakly_active": last["weakly_active"],
            "licq_failed": last["licq_failed"],
        }


class Tracker(Protocol):
    """An object that follows a training as `progress` of `train`; a function will do, too."""

    def start(self, run: TrainingRun) -> None:
        """Take note of the run, before its first sample."""

    def __call__(self, samples: int, row: LogRow) -> None:
        """Take a row of the log, at so many samples."""

    def end(self, training: Training) -> None:
        """Take the result, finished or diverged."""


def train(
    algorithm: str,
    scenario: Scenario | str | Path = "paper",
    samples: int | None = None,
    *,
    seed: int = 0,
    start: str | Path = TrainingRun.start,
    settings: Mapping[str, Any] | Configuration | None = None,
    controller: str = TrainingRun.controller,
    log_every: int | None = None,
    evaluate_every: int | None = None,
    checkpoint_every: int | None = None,
    evaluation_seeds: int = TrainingRun.evaluation_seeds,
    evaluation_steps: int = TrainingRun.evaluation_steps,
    divergence: float = TrainingRun.divergence,
    rest_after: int | None = TrainingRun.rest_after,
    out: str | Path | None = None,
    resume: bool = False,
    progress: Callable[[int, LogRow], None] | bool = False,
) -> Training:
    """Train a controller's θ on a scenario's plant; J* is that of its stored optimum, if any.

    Raises AlgorithmLookupError, ConfigurationError, ScenarioError, PlantError, CheckpointError,
    each in one line, before the work where that is possible; PrivilegeError where an algorithm asks
    more of the plant than it states. The arguments that are not below are `TrainingRun`'s fields.

    Args:
        algorithm: a registered name (`learning.algorithm.algorithms`) or `module:Class`.
        scenario: a scenario, a preset's name or a TOML file.
        samples: plant samples; None: the algorithm's budget, else 50 000.
        seed: seed of noise and exploration.
        start: where θ starts: naive, tuned, commissioned, cautious or a parameters file.
        settings: hyperparameters by name; the algorithm's Configuration documents them.
        out: folder of the run's checkpoints; None keeps none. `Training.save` writes the rest.
        resume: go on from the checkpoint in `out`.
        progress: a function of the samples done and the log's last row, or a `Tracker`; True draws
            a bar.
    """
    given = locals() | {"start": str(start)}
    if not isinstance(scenario, Scenario):
        scenario = Scenario.load(scenario)
    options = {name: given[name] for name in OPTIONS}
    run = prepare(algorithm, scenario, samples, settings, options)
    optimum = stored_optimum(scenario)
    return run_training(run, out, resume=resume, optimum=optimum, progress=progress)


def run_training(
    run: TrainingRun,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    optimum: str | None = None,
    progress: Callable[[int, LogRow], None] | bool = False,
    rule: type[Algorithm] | None = None,
) -> Training:
    """Train as `run` says; the other arguments and the errors are those of `train`.

    With `out`, learning.csv, parameters.toml and checkpoint.npz are kept there during the run; a
    plant that cannot serialise its state leaves no checkpoint. Log, evaluations and files are of
    the θ that the run would hand over then. Without an `optimum` regret and gap closed are unknown.
    `rule` is the algorithm's class where it is not to be looked up by its name.
    """
    clock = time.perf_counter()
    getattr(progress, "start", lambda _: None)(run)
    best = build_controller(optimum, run.scenario) if optimum else None
    folder = None if out is None else Path(out)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (LOG, PARAMETERS, CHECKPOINT):
            check_target(folder / name)
    with FmuPlant(run.scenario) as plant, FmuPlant(run.scenario) as evaluation_plant:
        session = _Session(run, rule or load_algorithm(run.algorithm), plant, folder)
        compile_functions(session.loop.controller, run.samples)
        if resume:
            session.load()
        else:
            session.checkpoint()
        judge = Judge(run, evaluation_plant, session.start, best)
        with reporting(progress, run.algorithm, run.samples, _Remark()) as tell:
            status = session.run_to_the_end(judge, tell)
        parameters = session.loop.parameters
        training = Training(
            run=run,
            parameters=parameters,
            rows=session.rows,
            evaluation=judge.verdict(parameters.theta),
            status=status,
            asks_for=session.loop.algorithm.asks_for,
            plant_samples=session.loop.counts.number,
            start=session.start,
            start_J=judge.start_J,
            baselines=judge.baselines,
            functions=functions_of(session.loop.controller),
            without_checkpoint=session.without_checkpoint,
            wall_seconds=time.perf_counter() - clock,
        )
    getattr(progress, "end", lambda _: None)(training)
    return training


class _Remark(dict[str, float]):
    """The last value of each column of the log, and the remark behind a bar made of them."""

    def __call__(self, done: int, row: LogRow) -> tuple[int, str]:
        self.update({name: value for name, value in row.items() if not isnan(value)})
        return done, "  ".join(f"{SHOWN[name]} {self[name]:.4g}" for name in SHOWN if name in self)


class _Session:
    """A run in progress: its loop, its log so far, and its checkpoint."""

    def __init__(
        self, run: TrainingRun, algorithm: type[Algorithm], plant: FmuPlant, out: Path | None
    ) -> None:
        self.run, self.plant, self.out = run, plant, out
        self.identity = run.identity()
        self.loop = begin(run, algorithm, plant)
        self.start = self.loop.start_parameters
        self.rows: list[LogRow] = []
        self.costs: list[float] = []  # and updates, since the last row
        self.updates: list[Update] = []
        self.without_checkpoint: str | None = None

    def run_to_the_end(self, judge: Judge, progress: Callable[[int, LogRow], None]) -> str:
        """Take all samples, with log, evaluations and checkpoints; `finished` or `diverged: …`."""
        run, loop = self.run, self.loop
        while (number := loop.counts.number) < run.samples:
            try:
                cost, update = loop.advance()
            except DivergenceError as error:
                self.rows.append(self.row(number + 1, judge))
                return f"diverged: {error} at sample {number + 1}"
            number += 1
            self.costs.append(cost)
            self.updates += [] if update is None else [update]
            if number % run.log_every and number < run.samples:
                continue
            judged = number % run.evaluate_every == 0 or number == run.samples
            row = self.row(number, judge if judged else None)
            self.rows.append(row)
            if trouble := self.trouble(row, judge):
                return trouble
            if number % run.checkpoint_every == 0 or number == run.samples:
                self.checkpoint()
            progress(number, row)
        return "finished"

    def row(self, number: int, judge: Judge | None) -> LogRow:
        """A line of the log since the last one, with an evaluation by a judge."""
        answer, counts = self.loop.parameters, asdict(self.loop.counts)
        updates, count = self.updates, len(self.updates) or float("nan")
        # Of all θ since the last row, whichever step gave it.
        least = [inf, *(update.smallest_eigenvalue for update in updates)]
        figures = dict.fromkeys(COLUMNS, float("nan")) | {
            "samples": number,
            "updates": len(updates),
            "J": _total(self.costs) / (len(self.costs) or float("nan")),
            "td_error": (_total(update.td_error**2 for update in updates) / count) ** 0.5,
            "step": _total(update.step for update in updates) / count,
            "smallest_eigenvalue": min(*least, smallest_eigenvalue(answer.blocks, answer.theta)),
            "corrected": sum(update.corrected for update in updates),
            "refused": sum(update.refused for update in updates),
            "plant_samples": counts.pop("number"),
        }
        figures |= counts
        self.costs, self.updates = [], []
        if judge is not None:
            verdict = judge.verdict(answer.theta)
            figures |= {f"greedy_{name}": verdict[name] for name in FIGURES}
            for name in ("regret", "gap_closed"):
                figures[name] = float("nan") if verdict[name] is None else verdict[name]
        return LogRow(figures, answer)

    def trouble(self, row: LogRow, judge: Judge) -> str | None:
        """Why the run must stop, or None: two evaluations in a row, or the last, are too dear."""
        greedy, limit = row["greedy_J"], judge.limit
        judged = [one["greedy_J"] for one in self.rows if isfinite(one["greedy_J"])]
        once = len(judged) < 2 or judged[-2] <= limit
        if not limit < greedy < inf or (once and row["samples"] < self.run.samples):
            return None
        reason = f"greedy J = {shown(greedy)} exceeds {shown(limit)}"
        return f"diverged: {reason} at sample {int(row['samples'])}"

    def checkpoint(self) -> None:
        """Start the solver afresh, as a resumed run will, and write the files of the run so far."""
        self.loop.restart()
        if self.out is None:
            return
        # Nothing of another run may stay beside the files of this one.
        with staged(self.out, FILES) as stage:
            write_atomically(stage / LOG, to_csv(self.rows))
            self.loop.parameters.save(stage / PARAMETERS)
            self._save_state(stage / CHECKPOINT)

    def _save_state(self, path: Path) -> None:
        """Write what resuming needs, where the plant can say its state."""
        try:
            plant = self.plant.serialise(self.plant.snapshot())
            state = self.loop.state()
        except CapabilityError as error:
            self.without_checkpoint = str(error)
            return
        state |= {
            "plant": np.frombuffer(plant, dtype=np.uint8),
            "rows": [[*row.values()] for row in self.rows],
            "row_thetas": np.array([row.parameters.theta for row in self.rows]),
        }
        checkpoint.save(path, self.identity, state)

    def load(self) -> None:
        """Load the folder's checkpoint; raises CheckpointError if none fits."""
        if self.out is None:
            raise ConfigurationError("a run without a folder cannot be resumed")
        state = checkpoint.load(path := self.out / CHECKPOINT, self.identity)
        try:
            self.rows = [
                LogRow(dict(zip(COLUMNS, figures, strict=True)), self.start.with_theta(theta))
                for figures, theta in zip(state["rows"], state["row_thetas"], strict=True)
            ]
            self.plant.restore(self.plant.deserialise(state["plant"].tobytes()))
            self.loop.restore(state)
        except Exception as error:  # whatever arrays of other names, shapes or kinds lead to
            said = " ".join(f"{type(error).__name__}: {error}".split())
            raise CheckpointError(
                f"{path}: the checkpoint does not hold the state of this run ({said}); begin anew "
                "by --overwrite"
            ) from error
