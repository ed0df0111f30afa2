"""Bars of `progress=True`: each ends where the work does."""

import pytest
import rich.progress

from cosim import FmuPlant, build_controller, evaluate, simulate, train
from tests.helpers.toy_study import case, run_toy


def a_simulation(paper, _):
    with FmuPlant(paper) as plant:
        simulate(plant, build_controller("naive", paper), 20, 0, progress=True)


def a_training(paper, _):
    few = {"evaluate_every": 20, "evaluation_seeds": 1, "evaluation_steps": 5, "log_every": 10}
    train("fixed", paper, 20, progress=True, **few)


def an_evaluation(paper, _):
    evaluate(paper, ["naive", "optimal"], 2, 10, progress=True)


def a_study(_, folder):
    run_toy(folder, report=True, case=[case("grow", samples=100)], training_seeds={"count": 1})


@pytest.mark.parametrize("work", [a_simulation, a_training, an_evaluation, a_study])
def test_a_bar_ends_full_with_the_work(work, paper, tmp_path, monkeypatch):
    bars = []

    class Seen(rich.progress.Progress):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            bars.append(self)

    monkeypatch.setattr(rich.progress, "Progress", Seen)
    work(paper, tmp_path)
    (bar,) = bars
    (task,) = bar.tasks
    assert task.completed == task.total > 0
