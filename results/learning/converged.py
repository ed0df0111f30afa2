"""The paper's last remark, at the first two fits: RTI and converged NMPC take different steps of θ.

    python results/learning/converged.py

Both learn from the very same transitions of the stochastic FMU, by the same rule (Gauss–Newton fits
of batch Q-learning, targets renewed in each) from the same θ; only what evaluates Q and V differs.
Writes OUT/converged.csv: an entry of θ a row, its change under either, in units of its scale.
"""

from __future__ import annotations

import argparse
import csv
import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from controllers.problem import Problem
from cosim import FmuPlant, Scenario
from cosim.files import write_atomically
from learning import BatchQLearning
from learning.average_cost import AverageCost
from learning.batch_q_learning import BatchQLearningConfiguration
from learning.constrained_step import ConstrainedStep
from learning.fit import least_squares
from learning.learner import Learner
from learning.protocols import LearnableController
from learning.replay import ReplayBuffer
from learning.starting_point import build_controller
from learning.training_run import TrainingRun

SAMPLES, ITERATIONS, GAIN, RADIUS = 150, 6, 0.5, 1.0
CONFIGURATION = BatchQLearningConfiguration.from_dict({})


def fill(scenario: Scenario) -> tuple[ReplayBuffer, Parameters]:
    """Transitions of the stochastic plant under RTI with exploration, and their θ."""
    run = TrainingRun("batch-q-learning", scenario, SAMPLES, 0, CONFIGURATION)
    buffer = ReplayBuffer(SAMPLES)
    with FmuPlant(scenario) as plant:
        learner = Learner(run, BatchQLearning, plant)
        learner.begin()
        for _ in range(SAMPLES):
            sample, _ = learner.interaction.next()
            if sample is not None:
                buffer.add(sample)
    return buffer, learner.start


def learn(
    scenario: Scenario, controller: LearnableController, buffer: ReplayBuffer
) -> NDArray[np.float64]:
    """Change of θ, scaled, after all fits to the buffer."""
    start = controller.theta.copy()
    step = ConstrainedStep(controller, CONFIGURATION)
    level = AverageCost(scenario.discount, 0, 1.0, 0.0)
    for _ in range(ITERATIONS):
        replayed = buffer.replay(controller, level)
        gradient = replayed.gradient * step.scale
        fit = least_squares(gradient.T @ gradient, gradient.T @ replayed.td_error, 1e-2)
        step.take(fit.shrunk(GAIN).clipped(RADIUS), 0.0)
    change: NDArray[np.float64] = (controller.theta - start) / step.scale
    return change


def main() -> None:
    """Learn with both and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/learning"))
    arguments = parser.parse_args()
    scenario = Scenario.load("paper")
    problem = Problem.from_scenario(scenario)
    buffer, start = fill(scenario)
    rti, converged = (
        learn(scenario, build_controller(kind, scenario, problem, start), buffer)
        for kind in ("rti", "converged")
    )
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(("entry", "rti", "converged"))
    for label, one, other in zip(start.blocks.labels, rti, converged, strict=True):
        writer.writerow((label, f"{one:.8g}", f"{other:.8g}"))
    write_atomically(arguments.out / "converged.csv", stream.getvalue())


if __name__ == "__main__":
    main()
