"""`TrainingOptions`: what one may choose of a training, described once for Python, files, commands.

It stands in the ground, since the command line shows it without importing a rule.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from inspect import Parameter, signature
from typing import Any, TypeVar, get_type_hints

CHECKPOINT = "checkpoint.npz"
LOG = "learning.csv"
PARAMETERS = "parameters.toml"
"""Files of a training: its checkpoint, its log, its θ."""
DEFAULT_SAMPLES = 50_000
"""Length of a run where neither user nor algorithm states one."""
LOG_EVERY = 1000
"""Samples per row of the log, where nothing else is asked for."""
EVALUATE_EVERY = 5000
"""Samples per greedy evaluation and per checkpoint, about, likewise."""
EVALUATION_STEPS = 500
"""Samples of a held-out run, where nothing else is asked for and the plant is known to be fast."""
SLOW_LOG_EVERY = 100
"""Samples a row of the log and a checkpoint, likewise, on a plant that may be slow: what a stop
loses is a minute at most where a step takes half a second.
"""
CHECKPOINT_PAUSE = 20
"""Least time between two checkpoints of another's FMU, in multiples of the time that one takes."""
HELD_OUT = 1_000_000
"""First of the held-out seeds; training seeds stay below."""
MOST = 100_000_000
"""Samples of the longest run."""
Function = TypeVar("Function", bound=Callable[..., Any])


@dataclass(frozen=True)
class Range:
    """Least and largest value of an option that is a number; None where there is no limit."""

    least: float
    most: float | None = None


def _within(least: float, most: float | None, default: float | None) -> Any:
    """A field of numbers from `least` to `most`."""
    return field(default=default, metadata={"range": Range(least, most)})


@dataclass(frozen=True, kw_only=True)
class TrainingOptions:
    """Options of a training beside its rule, its scenario and its samples.

    Attributes:
        seed: Seed of noise and exploration.
        start: Start of θ: naive, tuned, backed-off, cautious or a parameters file.
        controller: Solver of the NMPC: rti (one QP per sample) or converged.
        log_every: Samples per row of the log; default: 1000, or fewer to fit the other intervals.
        evaluate_every: Samples per greedy evaluation; default: about 5000.
        checkpoint_every: Samples per checkpoint; default: about 5000.
        evaluation_seeds: Held-out runs per evaluation; 0: none.
        evaluation_steps: Samples of each held-out run; default: 500. On an FMU of your own all
            runs together take at most a tenth of the training's samples.
        divergence: Factor of the start's J above which a run ends as diverged.
        rest_after: Samples after which learning and exploration stop; default: never.
    """

    seed: int = _within(0, HELD_OUT - 1, 0)
    start: str = "naive"
    controller: str = "rti"
    log_every: int | None = _within(1, MOST, None)
    evaluate_every: int | None = _within(1, MOST, None)
    checkpoint_every: int | None = _within(1, MOST, None)
    evaluation_seeds: int = _within(0, HELD_OUT, 4)
    evaluation_steps: int | None = _within(1, MOST, None)
    divergence: float = _within(1, None, 1.5)
    rest_after: int | None = _within(1, MOST, None)


OPTION_NAMES = tuple(option.name for option in fields(TrainingOptions))


def option_ranges() -> dict[str, Range]:
    """Ranges of the options that are numbers, by name."""
    ranges = {}
    for option in fields(TrainingOptions):
        if "range" in option.metadata:
            ranges[option.name] = option.metadata["range"]
    return ranges


def with_training_options(
    annotation: Callable[[str, Any], Any] = lambda name, kind: kind,
) -> Callable[[Function], Function]:
    """Decorator: show each training option in a function's signature, in place of `**options`.

    `help`, notebooks and the command line read the signature.

    Args:
        annotation: gives an option's annotation from its name and type.
    """
    kinds = get_type_hints(TrainingOptions)
    options = []
    for option in fields(TrainingOptions):
        shown_as = annotation(option.name, kinds[option.name])
        options.append(
            Parameter(
                option.name,
                Parameter.KEYWORD_ONLY,
                default=option.default,
                annotation=shown_as,
            )
        )

    def show(function: Function) -> Function:
        written = signature(function, eval_str=True)
        parameters = list(written.parameters.values())
        assert parameters[-1].kind is Parameter.VAR_KEYWORD
        parameters[-1:] = options
        # `inspect.signature` takes this for the signature, and so do all who call it.
        function.__dict__["__signature__"] = written.replace(parameters=parameters)
        return function

    return show
