"""The trainings of a reproduction: tasks for workers, each a `cosim train` command done once."""

from __future__ import annotations

import json
import shlex
from contextlib import chdir
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from cosim.reproduction.budget import Budget, Learner

if TYPE_CHECKING:
    from cosim.reproduction.readings import Reading

STATE = "state.json"
LOG_EVERY = 500


@dataclass(frozen=True)
class Training:
    """One training of a learner; `scenario` is what `--scenario` takes in the folder `root`."""

    learner: Learner
    scenario: str
    seed: int
    root: Path
    name: str

    @property
    def folder(self) -> Path:
        """Where the training's files are."""
        return self.root / "training" / self.name

    def command(self) -> str:
        """The command, without `--out`, as typed in `root`."""
        words = ["cosim", "train", "--algorithm", self.learner.algorithm]
        words += ["--scenario", self.scenario, "--samples", str(self.learner.samples)]
        words += ["--seed", str(self.seed), "--evaluate-every", str(self.learner.samples)]
        words += ["--log-every", str(LOG_EVERY)]
        for setting in self.learner.settings:
            words += ["--set", setting]
        return shlex.join(words)


def train(task: Training) -> str:
    """Run a training unless its folder holds it already; returns its status, `finished` or why not.

    A training counts as there, and one that was interrupted goes on from its checkpoint, if the
    command and the hash of all code are the same. Raises what `cosim train` raises, but takes
    divergence for a result: the last good θ is stored then.
    """
    from cosim.cli.inner import run_command
    from cosim.evaluation.provenance import PACKAGES, code_hash
    from cosim.files import write_atomically

    task.folder.mkdir(parents=True, exist_ok=True)
    facts = {"command": task.command(), "code": code_hash((*PACKAGES, "learning"))}
    state, words = task.folder / STATE, shlex.split(task.command())[1:]
    known = json.loads(state.read_text("utf-8")) if state.is_file() else {}
    if known != facts | {"done": True}:
        if known == facts and (task.folder / "checkpoint.npz").is_file():
            words.append("--resume")
        write_atomically(state, json.dumps(facts))
        with chdir(task.root):
            run_command(words, task.folder, accepted=(0, 1))
        write_atomically(state, json.dumps(facts | {"done": True}))
    summary = json.loads((task.folder / "summary.json").read_text("utf-8"))
    return str(summary["status"])


def trainings(sizes: Budget, folder: Path) -> dict[str, Training]:
    """Every training of the reproduction by its key; those on `paper` come first.

    Writes the scenarios of the map into `folder`.
    """
    from cosim.files import write_atomically
    from cosim.reproduction.readings import Reading, readings
    from cosim.scenario import Scenario

    tasks = {
        key: Training(learner, "paper", seed, folder, key)
        for learner in sizes.learners
        for seed, key in enumerate(trained(learner, sizes.training_seeds))
    }
    paper = Scenario.load("paper")
    for reading in readings(sizes.factorial):
        if reading == Reading():
            continue
        path = folder / "map" / f"{reading.name}.toml"
        path.parent.mkdir(exist_ok=True)
        write_atomically(path, reading.scenario(paper).to_toml())
        source = path.relative_to(folder).as_posix()
        for seed, key in enumerate(mapped(sizes, reading).values()):
            tasks[key] = Training(sizes.mapper, source, seed, folder, key)
    return tasks


def trained(learner: Learner, seeds: int) -> list[str]:
    """Names of a learner's controllers in the tables, one per training seed."""
    return [f"{learner.name}-{seed}" for seed in range(seeds)]


def mapped(sizes: Budget, reading: Reading) -> dict[str, str]:
    """Keys of the trainings that the map shows at a reading, by their controllers' names there.

    The reading that is the scenario `paper` shows those of the comparison.
    """
    from cosim.reproduction.readings import Reading

    names = trained(sizes.mapper, sizes.map_seeds)
    prefix = "" if reading == Reading() else f"map-{reading.name}-"
    return {name: f"{prefix}{name}" for name in names}


def figure(task: Training, folder: Path) -> str:
    """Draw the paper's figure for a training, PNG and SVG; returns the PNG's name."""
    import numpy as np

    from cosim.evaluation.statistics import TD_WINDOW, td_error_mean
    from cosim.figures import plot_parameters_and_td_error
    from cosim.reproduction.curves import increments, read_log

    log = read_log(task.folder / "learning.csv")
    td_error = td_error_mean(log["samples"], log["td_error"], log["updates"])
    samples = np.concatenate([[0.0], log["samples"]])
    moved = {
        block: np.vstack([np.zeros(values.shape[1]), values])
        for block, values in increments(log, _start(task)).items()
    }
    name = f"parameters-{task.learner.name}"
    for suffix in ("png", "svg"):
        plot_parameters_and_td_error(
            samples,
            moved,
            log["samples"],
            td_error,
            folder / f"{name}.{suffix}",
            window=TD_WINDOW,
        )
    return f"{name}.png"


def _start(task: Training) -> dict[str, float]:
    """Entries of θ₀ by label."""
    from controllers.problem import Problem
    from cosim.scenario import Scenario
    from learning.registry import load_algorithm
    from learning.starting_point import starting_parameters

    configuration = load_algorithm(task.learner.algorithm).Configuration.from_assignments(
        task.learner.settings
    )
    problem = Problem.from_scenario(cast("Any", Scenario.load(task.folder / "scenario.toml")))
    start = starting_parameters(problem, configuration)
    return dict(zip(start.blocks.labels, start.theta.tolist(), strict=True))
