"""A training run: its settings, checked, and the θ, controller and loop that it starts with."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypedDict

import numpy as np

from controllers.economic import tune
from controllers.factories import nmpc
from controllers.problem import Problem
from controllers.theta import Parameters, ThetaBlocks
from cosim.plant import FmuPlant
from cosim.plugins import depends_on
from cosim.protocols import Vector
from cosim.scenario import Scenario
from cosim.simulation import spawn_seeds
from cosim.validation import suggestion
from learning.algorithm import Algorithm, load_algorithm
from learning.commissioning import back_off
from learning.configuration import Configuration
from learning.errors import ConfigurationError, PrivilegeError
from learning.loop import TrainingLoop

SAMPLES = 50_000
"""Of a run where neither user nor algorithm says how many."""
EVERY = ("log_every", "evaluate_every", "checkpoint_every")
LEAST = {"seed": 0} | dict.fromkeys(
    ("samples", *EVERY, "evaluation_seeds", "evaluation_steps", "rest_after"), 1
)


@dataclass(frozen=True)
class TrainingRun:
    """What identifies a training run; a checkpoint goes on only in the very same one.

    The `algorithm` by name, its `configuration`, completed by what the `scenario` states; the other
    fields' meaning is their help in `cosim train`. A greedy J that is worse than that of the naive
    θ and that of the start by more than (`divergence` − 1) of its magnitude, twice in a row or at
    the end, is divergence and ends the run.

    Raises ConfigurationError on counts that make no run.
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
        """Complete the configuration and check the counts."""
        completed = self.configuration.for_scenario(self.scenario)
        object.__setattr__(self, "configuration", completed)
        for name, least in LEAST.items():
            if (value := getattr(self, name)) is not None and value < least:
                raise ConfigurationError(f"{name} must be at least {least}, not {value}")
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
        """θ where the run starts; the errors are those of `starting_parameters` below."""
        problem = Problem.from_scenario(self.scenario)
        if self.start != "commissioned":
            return starting_parameters(problem, self.configuration, self.start)
        return back_off(starting_parameters(problem, self.configuration, "tuned"), self.scenario)


class Options(TypedDict, total=False):
    """The fields of `TrainingRun` that `train` takes as further keywords."""

    controller: str
    log_every: int
    evaluate_every: int
    checkpoint_every: int
    evaluation_seeds: int
    evaluation_steps: int
    divergence: float
    rest_after: int | None


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
    known = [option.name for option in fields(TrainingRun)]
    for name in options:
        if name not in known:
            raise ConfigurationError(f"training has no option '{name}'{suggestion(name, known)}")
    if not isinstance(settings, Configuration):
        settings = found.Configuration.from_dict(dict(settings or {}))
    return TrainingRun(
        algorithm=algorithm,
        scenario=scenario,
        samples=getattr(found, "budget", SAMPLES) if samples is None else samples,
        configuration=settings,
        **options,
    )


def begin(run: TrainingRun, algorithm: type[Algorithm], plant: FmuPlant) -> TrainingLoop:
    """The loop of a run at its start: the plant is reset, once, and the first state is solved for.

    All random numbers come from the run's seed.
    """
    controller = nmpc(run.scenario, run.starting_parameters(), run.controller)
    strategy = run.configuration.strategy(run.scenario)
    plant_seed, rng = spawn_seeds(run.seed)
    # The third child of the run's seed sequence; `spawn_seeds` takes the first two.
    own = np.random.default_rng(np.random.SeedSequence(run.seed).spawn(3)[2])
    rule = algorithm(controller, run.scenario, run.configuration, run.samples, strategy, own)
    loop = TrainingLoop(plant, controller, rule, strategy, rng, run.rest_after, own)
    first: int | None = getattr(rule, "first_episode", None)
    if first is not None and rule.asks_for != "simulator":
        raise PrivilegeError(
            f"{algorithm.__name__} asks for a plant in operation and states 'first_episode', which "
            "only a simulator has"
        )
    loop.start(plant.reset(plant_seed if first is None else first))
    return loop


def starting_parameters(
    problem: Problem, configuration: Configuration, start: str = "naive"
) -> Parameters:
    """θ at the start: the paper's naive one, the economically tuned one, or that of a file.

    `start` is `naive`, `tuned` or the path of a parameters file. `naive` and `tuned` take c_lambda
    from the configuration; blocks that a file has stand as they are, those of the configuration's
    parametrisation that it lacks start as with `naive`. Raises ConfigurationError where the file
    has slack weights and the parametrisation none, ParameterError on a bad file, TuningError where
    the tuning fails.
    """
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
    offset = problem.value_level(chosen) if discounted else None
    if start == "tuned":
        found = tune(problem, blocks, value_offset=offset).parameters
    else:
        found = Parameters.naive(problem, blocks, value_offset=offset)
    names = [name for name in ("w_sigma", "W_sigma") if name in blocks]
    values: dict[str, Vector] = {name: blocks.scale[blocks.slices[name]] for name in names}
    if file is not None:
        values |= {block.name: file[block.name] for block in file.blocks}
    if given:
        values["p"] = np.concatenate([values["p"], found["p"][len(given) :]])
    return found.replace(values)
