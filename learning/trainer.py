"""The trainer of `cosim study`: trainings in pieces, as the engine's protocol asks for them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any, get_args, get_origin

from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.evaluation.provenance import source_hashes
from cosim.files import temporary_folder
from cosim.lookup import GROUP as CONTROLLERS
from cosim.lookup import build_controller as controller_by_name
from cosim.lookup import import_from_here
from cosim.plugins import ALGORITHMS
from cosim.protocols import Controller
from cosim.scenario import Scenario
from cosim.study.protocols import Progress, Training
from learning.algorithm import load_algorithm
from learning.errors import ConfigurationError
from learning.evaluation import stored_optimum
from learning.log import COLUMNS, LogRow, to_csv
from learning.training import CHECKPOINT, run_training
from learning.training_run import TrainingRun, build_controller, prepare, starting_parameters

SEQUENCES = (list, tuple, set, frozenset)


class _HandOver(Exception):
    """Ends a piece of a training at a checkpoint."""


class Trainer:
    """Trains with the registered algorithms, and anyone's `module:Class`."""

    def check(self, training: Training) -> None:
        """Raise LearningError, in one line, where this training cannot begin."""
        _run(training)

    def takes_list(self, algorithm: str, setting: str) -> bool:
        """Whether a hyperparameter is a list itself; raises AlgorithmLookupError."""
        import_from_here()
        field = load_algorithm(algorithm).Configuration.model_fields.get(setting)
        return field is not None and _is_sequence(field.annotation)

    def advance(self, training: Training, checkpoint: bytes, seconds: float) -> Progress:
        """Train from a checkpoint (b"": the start) to the first one after `seconds`, or the end."""
        run, begin = _run(training), time.perf_counter()
        reached = 0

        def hand_over(samples: int, _: LogRow) -> None:
            nonlocal reached
            reached = samples
            at_checkpoint = samples % run.checkpoint_every == 0 and samples < run.samples
            late = time.perf_counter() - begin >= seconds
            # A plant that leaves no checkpoint is trained in one piece.
            if at_checkpoint and late and (folder / CHECKPOINT).is_file():
                raise _HandOver

        with temporary_folder("cosim-training-") as folder:
            if checkpoint:
                (folder / CHECKPOINT).write_bytes(checkpoint)
            try:
                result = run_training(run, folder, resume=bool(checkpoint), progress=hand_over)
            except _HandOver:
                return Progress(
                    reached,
                    checkpoint=(folder / CHECKPOINT).read_bytes(),
                    wall_seconds=time.perf_counter() - begin,
                )
            result.parameters.save(folder / "parameters.toml")
            samples = int(result.rows[-1]["samples"]) if result.rows else reached
            return Progress(
                samples,
                result.status,
                log=to_csv(_with_start(result.start, result.rows)),
                parameters=(folder / "parameters.toml").read_text("utf-8"),
                plant_samples=result.plant_samples,
                wall_seconds=time.perf_counter() - begin,
                functions=result.functions,
            )

    def policy(self, training: Training, parameters: str) -> Controller:
        """The greedy controller of a training's θ."""
        problem = Problem.from_scenario(training.scenario)
        with temporary_folder("cosim-theta-") as folder:
            path = folder / "parameters.toml"
            path.write_text(parameters, "utf-8")
            theta = Parameters.load(path, problem)
        return build_controller(training.nmpc, training.scenario, theta)

    def scales(self, training: Training) -> Mapping[str, float]:
        """Learning scale of each entry of θ, by its column of the log."""
        run = _run(training)
        problem = Problem.from_scenario(run.scenario)
        blocks = starting_parameters(problem, run.configuration, run.start).blocks
        names = (f"theta {label}" for label in blocks.labels)
        return dict(zip(names, blocks.scale.tolist(), strict=True))

    def controller(self, name: str, scenario: Scenario) -> Controller:
        """A controller by name, parameters file or `module:factory`; ControllerLookupError."""
        return controller_by_name(name, scenario)

    def optimum(self, scenario: Scenario) -> str | None:
        """`optimal` where the scenario's optimal policy is stored."""
        return stored_optimum(scenario)

    def sources(self, target: str) -> Mapping[str, str]:
        """Hashes of the foreign files that an algorithm or a controller is made of."""
        import_from_here()
        for group in (CONTROLLERS, ALGORITHMS):
            for point in entry_points(group=group):
                if point.name == target:
                    return source_hashes(point.value)
        return source_hashes(target)


def _with_start(start: Parameters, rows: list[LogRow]) -> list[LogRow]:
    """The log with a first row of θ at the start, from which its increments are counted."""
    figures = dict.fromkeys(rows[0] if rows else COLUMNS, float("nan")) | {"samples": 0.0}
    return [LogRow(figures, start), *rows]


def _run(training: Training) -> TrainingRun:
    options = {
        "seed": training.seed,
        "controller": training.nmpc,
        "start": training.start,
        "log_every": training.log_every,
        "evaluate_every": training.evaluate_every,
        "checkpoint_every": training.checkpoint_every,
        "evaluation_seeds": training.evaluation_seeds,
        "evaluation_steps": training.evaluation_steps,
    }
    if twice := sorted(options.keys() & training.options):
        raise ConfigurationError(f"training: {twice[0]} is given by the study itself")
    options |= training.options
    return prepare(
        training.algorithm, training.scenario, training.samples, training.settings, options
    )


def _is_sequence(annotation: Any) -> bool:
    """Whether a type is a sequence, or may be one."""
    origin = get_origin(annotation)
    if origin in SEQUENCES or annotation in SEQUENCES:
        return True
    return any(_is_sequence(part) for part in get_args(annotation) if part is not Ellipsis)
