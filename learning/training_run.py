"""Set-up of a training: its identity, its start, and its loop at the start."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, fields, replace
from math import gcd, isfinite
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np

from controllers.economic import tune
from controllers.estimator import ExtendedKalmanFilter
from controllers.factories import nmpc
from controllers.problem import Problem, given_parameters
from controllers.theta import Parameters, ThetaBlocks, add_margin
from cosim.core.protocols import Vector
from cosim.core.scenario import EstimatorTable, Scenario
from cosim.core.sensors import require_readings
from cosim.core.signals import period_of
from cosim.core.simulation import spawn_seeds
from cosim.core.training_options import (
    DEFAULT_SAMPLES,
    EVALUATE_EVERY,
    EVALUATION_STEPS,
    HELD_OUT,
    LOG_EVERY,
    MOST,
    SLOW_LOG_EVERY,
    Range,
    TrainingOptions,
    option_ranges,
)
from cosim.core.validation import suggestion
from cosim.identity import depends_on
from cosim.plant import FmuPlant
from cosim.plant.fmi import steps_are_fast
from learning.algorithm import Algorithm, load_algorithm
from learning.backed_off import add_reserve, back_off
from learning.configuration import Configuration
from learning.errors import ConfigurationError
from learning.exploration import Strategy
from learning.loop import TrainingLoop
from learning.retreat import Retreat

STARTS = ("naive", "tuned", "backed-off", "cautious")
CARRIERS = ("rti", "converged")
"""Controllers that can carry θ."""
OPTION_KINDS: dict[str, type] = {
    "int": Integral,
    "float": Real,
    "str": str,
}
"""Types that stand for a field's, NumPy's numbers among them."""
WORDS = {
    "int": "a whole number",
    "float": "a number",
    "str": "a text",
}
"""The same in messages."""
HELD_OUT_SHARE = 10
"""Training samples per held-out sample, at least, on a plant that may be slow."""
SHORTEST = 10
"""Samples of a held-out run that says something, at least."""


@dataclass(frozen=True)
class TrainingRun(TrainingOptions):
    """The identity of a training run; only an identical one can resume a checkpoint.

    A run ends as diverged if its greedy J exceeds the larger of the naive θ's and the start's by
    more than (divergence − 1) of its magnitude. It must do so twice in a row, or at the end.

    Attributes:
        algorithm: name of a registered one, or `module:Class`.
        scenario: the plant, its bounds and costs.
        samples: of the plant.
        configuration: the hyperparameters; completed by what the scenario states.
        log_every: samples per row of the log.
        evaluate_every: samples per greedy evaluation of θ.
        checkpoint_every: samples per checkpoint.
        evaluation_steps: samples of a held-out run.

    Raises:
        ConfigurationError: options of another kind, or that make no run.
    """

    algorithm: str
    scenario: Scenario
    samples: int
    configuration: Configuration
    _: KW_ONLY
    log_every: int = LOG_EVERY
    evaluate_every: int = EVALUATE_EVERY
    checkpoint_every: int = EVALUATE_EVERY
    evaluation_steps: int = EVALUATION_STEPS

    def __post_init__(self) -> None:
        # Completed first: the identity is that of the hyperparameters in force.
        completed = self.configuration.for_scenario(self.scenario)
        object.__setattr__(self, "configuration", completed)
        _check_options(self)
        _check_samples(self.samples)
        # An evaluation stands in a row of the log, and a checkpoint ends with one.
        for name in ("evaluate_every", "checkpoint_every"):
            value = getattr(self, name)
            if value % self.log_every:
                raise ConfigurationError(
                    f"{name} = {value} must be a multiple of log_every = {self.log_every}"
                )

    def identity(self) -> dict[str, Any]:
        """The run as JSON-ready values, with the hashes of all code that its result depends on."""
        # All attributes: whatever differs makes another run.
        values: dict[str, Any] = {}
        for option in fields(self):
            values[option.name] = getattr(self, option.name)
        values["scenario"] = self.scenario.hash
        values["configuration"] = self.configuration.model_dump(mode="json")
        file = Path(self.start)
        if file.is_file():
            # By its content: the same name may hold another θ tomorrow.
            digest = hashlib.sha256(file.read_bytes())
            values["start"] = digest.hexdigest()[:16]
        values["source"] = depends_on(self.scenario, self.algorithm)
        return values

    def starting_parameters(self) -> Parameters:
        """θ where the run starts; raises what the function `starting_parameters` raises."""
        start = self._starting_parameters()
        table = self.scenario.estimator or EstimatorTable()
        has_filter = bool(self.scenario.sensors) and table.kind == "ekf"
        # Without a filter that reads them these would be entries of θ without an effect.
        if has_filter and getattr(self.configuration, "noise", False):
            estimator = ExtendedKalmanFilter.from_scenario(self.scenario)
            start = estimator.add_noise(start)
        if has_filter and getattr(self.configuration, "margin", False):
            start = add_margin(start, Problem.from_scenario(self.scenario))
        # A replay has the state and not how far off it was.
        if "margin" in start.blocks and load_algorithm(self.algorithm).needs_points:
            raise ConfigurationError(
                f"{self.algorithm} replays transitions, which do not say by how much the block "
                "margin of θ tightened the bounds: take another rule or a θ without it"
            )
        return start

    def _starting_parameters(self) -> Parameters:
        """The same without the blocks `noise` and `margin`, but for those of a file."""
        problem = Problem.from_scenario(self.scenario)
        if self.start not in ("backed-off", "cautious"):
            return starting_parameters(problem, self.configuration, self.start)
        tuned = starting_parameters(problem, self.configuration, "tuned")
        backed_off = back_off(tuned, self.scenario)
        if self.start == "backed-off":
            return backed_off
        return add_reserve(backed_off, self.scenario)


def make_run(
    algorithm: str,
    scenario: Scenario,
    samples: int | None = None,
    settings: Mapping[str, Any] | Configuration | None = None,
    options: TrainingOptions | None = None,
) -> TrainingRun:
    """The run of an algorithm by name, checked.

    Args:
        algorithm: name of a registered one, or `module:Class`.
        scenario: the plant, its bounds and costs.
        samples: of the plant; None: the algorithm's budget, else 50 000.
        settings: hyperparameters by name, or all of them.
        options: all others; an interval that is None is near its default and fits the others.

    Raises:
        AlgorithmLookupError: there is no such algorithm.
        ConfigurationError: settings or options of another kind, or that make no run.
    """
    rule = load_algorithm(algorithm)
    if options is None:
        options = TrainingOptions()
    if settings is not None and not isinstance(settings, Configuration | Mapping):
        raise ConfigurationError(f"settings must be a table, not a {type(settings).__name__}")
    if not isinstance(settings, Configuration):
        settings = rule.Configuration.from_dict(dict(settings or {}))
    if samples is None:
        samples = getattr(rule, "budget", DEFAULT_SAMPLES)
    _check_samples(samples)
    options = _with_intervals(options, is_fast=steps_are_fast(scenario.plant.fmu))
    options = _with_held_out_runs(options, scenario, samples)
    return TrainingRun(algorithm, scenario, samples, settings, **vars(options))


def _with_intervals(options: TrainingOptions, *, is_fast: bool) -> TrainingOptions:
    """Options with each interval of log, evaluations and checkpoints; raises ConfigurationError.

    Args:
        options: what was chosen.
        is_fast: whether the plant is known to be fast.
    """
    _check_options(options)
    log_every = options.log_every
    if log_every is None:
        longest = LOG_EVERY if is_fast else SLOW_LOG_EVERY
        log_every = _fitting_log_interval(options.evaluate_every, options.checkpoint_every, longest)
    # Near their default, on rows of the log.
    near_default = log_every * max(1, round(EVALUATE_EVERY / log_every))
    checkpoint_every = near_default if is_fast else log_every
    return replace(
        options,
        log_every=log_every,
        evaluate_every=options.evaluate_every or near_default,
        checkpoint_every=options.checkpoint_every or checkpoint_every,
    )


def _with_held_out_runs(
    options: TrainingOptions, scenario: Scenario, samples: int
) -> TrainingOptions:
    """Options with the length of the held-out runs, or without these where none fits.

    How long a step of another's FMU takes is not known, and a rule by a clock would make the same
    command give other digits: there all held-out runs together are a share of the training.
    """
    if options.evaluation_steps is not None:
        return options
    # A part of a day says nothing of what the day costs.
    longest = _in_whole_periods(EVALUATION_STEPS, period_of(scenario) or 1)
    if steps_are_fast(scenario.plant.fmu) or not options.evaluation_seeds:
        return replace(options, evaluation_steps=longest)
    assert options.evaluate_every is not None
    evaluations = most_evaluations(samples, options.evaluate_every)
    n_runs = evaluations * options.evaluation_seeds
    held_out_samples = samples // HELD_OUT_SHARE
    steps = held_out_samples // n_runs
    if steps < SHORTEST:
        return replace(options, evaluation_seeds=0, evaluation_steps=longest)
    return replace(options, evaluation_steps=min(steps, longest))


def most_evaluations(samples: int, evaluate_every: int) -> int:
    """Controllers that a training evaluates on held-out noise, at most.

    They are θ after each interval and at the end, the start, naive, and the optimum if known.

    Args:
        samples: of the training.
        evaluate_every: samples of an interval.
    """
    return (samples - 1) // evaluate_every + 4


def _fitting_log_interval(
    evaluate_every: int | None, checkpoint_every: int | None, longest: int
) -> int:
    """Largest interval up to the longest that divides the others where these are given."""
    together = gcd(evaluate_every or 0, checkpoint_every or 0)
    interval = longest
    while together % interval:
        interval -= 1
    return interval


def _check_options(options: TrainingOptions) -> None:
    """Refuse options of another kind or outside their range by ConfigurationError."""
    ranges = option_ranges()
    for option in fields(TrainingOptions):
        value = getattr(options, option.name)
        # With postponed evaluation, a field's type is its text: `int | None`.
        kind, _, alternative = str(option.type).partition(" | ")
        if value is None and alternative == "None":
            continue
        # Python's bool is an integer, a TOML file's is not.
        is_of_kind = isinstance(value, OPTION_KINDS[kind]) and not isinstance(value, bool)
        if not is_of_kind:
            raise ConfigurationError(
                f"training: {option.name} must be {WORDS[kind]}, not {value!r:.60}"
            )
        if option.name in ranges:
            _check_range(option.name, value, ranges[option.name])
    if options.controller not in CARRIERS:
        raise ConfigurationError(
            f"training: there is no controller '{options.controller}'; there are rti and converged"
        )


def _check_samples(samples: int) -> None:
    """Refuse a number of samples that makes no run by ConfigurationError."""
    if not isinstance(samples, Integral) or isinstance(samples, bool):
        raise ConfigurationError(f"training: samples must be {WORDS['int']}, not {samples!r:.60}")
    _check_range("samples", samples, Range(1, MOST))


def _check_range(
    name: str,
    value: float,
    limits: Range,
) -> None:
    """Refuse a number outside its range by ConfigurationError."""
    if name == "seed" and value >= HELD_OUT:
        raise ConfigurationError(
            f"training: seed must be below {HELD_OUT}, not {value}: the noise from there on is "
            "held out, to evaluate what was learned"
        )
    if not isfinite(value) or value < limits.least:
        raise ConfigurationError(f"training: {name} must be at least {limits.least}, not {value}")
    if limits.most is not None and value > limits.most:
        raise ConfigurationError(f"training: {name} must be at most {limits.most}, not {value}")


def begin_training(
    run: TrainingRun,
    algorithm: type[Algorithm],
    plant: FmuPlant,
) -> TrainingLoop:
    """The loop of a run at its start: the plant is reset, once, and the first state is solved for.

    All random numbers come from the run's seed.

    Args:
        run: the run.
        algorithm: class of its rule.
        plant: of its scenario.
    """
    if run.scenario.sensors and not getattr(algorithm, "learns_from_estimates", False):
        raise ConfigurationError(
            f"{run.algorithm} learns from exact states, and scenario '{run.scenario.name}' has "
            "sensors: use an algorithm that learns from estimates, such as q-learning"
        )
    if run.scenario.sensors:
        algorithm = getattr(algorithm, "under_sensors", algorithm)
    if run.scenario.signals and not getattr(algorithm, "learns_under_signals", False):
        raise ConfigurationError(
            f"scenario '{run.scenario.name}' has signals, and {run.algorithm} cannot learn under "
            "signals: use q-learning, model-based or fixed; or train on the scenario without "
            "[[signal]] and evaluate θ on this one"
        )
    # Each source of randomness has its own stream, so that settings keep runs paired.
    start = run.starting_parameters()
    controller = nmpc(run.scenario, start, run.controller)
    strategy = Strategy(run.configuration, run.scenario)
    plant_seed, rng = spawn_seeds(run.seed)
    # The third child of the run's seed sequence; `spawn_seeds` takes the first two.
    seed_sequence = np.random.SeedSequence(run.seed)
    _, _, third_child = seed_sequence.spawn(3)
    algorithm_rng = np.random.default_rng(third_child)
    rule = algorithm(
        controller,
        run.scenario,
        run.configuration,
        run.samples,
        strategy,
        algorithm_rng,
    )
    loop = TrainingLoop(
        plant,
        controller,
        rule,
        strategy,
        rng,
        run.rest_after,
        algorithm_rng,
        _retreat(run, rule, controller.theta),
    )
    require_readings(run.scenario, run.samples + 1)
    if loop.signals is not None:
        # The state after the last sample is solved for, too.
        loop.signals.require(run.samples + 1)
        loop.signals.foresee(plant, plant_seed, run.samples + 1)
    # A rule on a simulator says where its first episode begins.
    first_episode = getattr(rule, "first_episode", None)
    if first_episode is None:
        loop.start(plant.reset(plant_seed), plant.y)
    else:
        simulator = loop.simulator("first_episode")
        loop.start(simulator.reset(first_episode), simulator.y)
    return loop


def _retreat(
    run: TrainingRun,
    rule: Algorithm,
    start: Vector,
) -> Retreat | None:
    """Comparison of a run's shifts; None for a rule that tries θ, on the plant or a simulator."""
    configuration = run.configuration
    tries = rule.requires == "simulator" or hasattr(rule, "theta")
    if tries or not configuration.retreat_probability:
        return None
    shift = _shift_samples(configuration.shift_hours, run.scenario)
    if shift is None:
        return None
    return Retreat(start, shift, configuration.retreat_probability)


def _shift_samples(hours: float, scenario: Scenario) -> int | None:
    """Samples of a shift, whose cost is compared with that of others; None where none can be.

    Under signals these are whole periods, so that no hour's price stands for what θ costs.

    Args:
        hours: of a shift at least.
        scenario: has the sampling time, and perhaps signals.
    """
    shift = round(3600.0 * hours / scenario.sampling_time)
    period = period_of(scenario)
    return None if period is None else _in_whole_periods(shift, period)


def _in_whole_periods(samples: int, period: int) -> int:
    """The least multiple of a period from so many samples on."""
    return -(-samples // period) * period


def starting_parameters(
    problem: Problem,
    configuration: Configuration,
    start: str = "naive",
) -> Parameters:
    """θ at the start: the paper's naive one, the economically tuned one, or that of a file.

    `naive` and `tuned` take c_lambda from the configuration; blocks that a file lacks start as with
    `naive`.

    Args:
        problem: the controller's.
        configuration: says which blocks θ has.
        start: `naive`, `tuned` or the path of a file of θ.

    Raises:
        ConfigurationError: the file has slack weights and the parametrisation none.
        ParameterError: a bad file.
        TuningError: the tuning fails.
    """
    # A word close to a start's is a slip, where there is no file of that name.
    meant = suggestion(start, STARTS)
    if start not in STARTS and meant and not Path(start).exists():
        raise ConfigurationError(f"there is no start '{start}'{meant}, nor such a parameters file")
    file = None
    if start not in ("naive", "tuned"):
        file = Parameters.load(start, problem)
    has_slack_weights = file is not None and "w_sigma" in file.blocks
    if has_slack_weights and configuration.parametrisation == "paper":
        raise ConfigurationError(
            f"{start}: θ has slack weights, which the parametrisation 'paper' has not; set "
            "parametrisation=extended"
        )
    # The file's parameters first, in its order, then those that are learned.
    labels: list[str] = []
    noise: tuple[str, ...] = ()
    if file is not None and "noise" in file.blocks:
        noise = file.blocks.block("noise").labels
    if file is not None and "p" in file.blocks:
        labels += file.blocks.block("p").labels
    # What a signal gives of the model is known, and nothing to learn.
    given = given_parameters(problem.varying, problem.model)
    for name in configuration.learned_parameters(problem.model):
        if name not in labels and name not in given:
            labels.append(name)
    blocks = ThetaBlocks.from_problem(
        problem,
        slack_weights=configuration.parametrisation == "extended",
        model_parameters=tuple(labels),
        margin=file is not None and "margin" in file.blocks,
        noise=noise,
    )
    # What a file does not say begins as with `naive`.
    if start == "tuned":
        theta = tune(problem, blocks).parameters
    else:
        theta = Parameters.naive(problem, blocks)
    if configuration.value_offset == "discounted":
        # The level of V is that of the TD error's discount.
        discount: float | None = getattr(configuration, "discount", None)
        theta = theta.replace({"c_lambda": problem.value_level(discount)})
    # At their scale the penalty is exact (`Units`).
    for name in ("w_sigma", "W_sigma"):
        if name in blocks:
            scale = blocks.scale[blocks.slices[name]]
            theta = theta.replace({name: scale})
    return theta if file is None else file.placed_in(theta)
