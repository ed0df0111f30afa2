"""Where the trainings of a study led θ: the table of its course and of differences."""

import csv

import numpy as np
import pytest

from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.studies import run as engine
from cosim.studies.store import Trained
from tests.helpers.toy_study import GROW, run_toy

ROWS = {0: 0.0, 200: 3.0, 500: 6.0, 700: 7.0, 800: 9.0, 1000: 10.0}
"""How far θ has come, by samples."""


def wander(training, folder, marks):
    """g goes from 0 to 10, faster with `rate`, and further with the seed; h moves from 1 to 2."""
    factor = training.settings["rate"] * (1 + training.options["seed"])
    log = "samples,J,greedy_J,td_error,theta g,theta h[0]\n"
    for samples, way in ROWS.items():
        log += f"{samples},1,{6900 if samples else ''},1,{factor * way},{1 + way / 10}\n"
    theta = Parameters.naive(Problem.from_scenario(training.scenario))
    theta["x_l"][:] += factor / 10
    theta.save(folder / "theta.toml")
    text = (folder / "theta.toml").read_text("utf-8")
    return Trained(1000, "finished", log, text, 1000, 0.1)


def wandering(folder, **theta):
    case = [
        {"name": "go", "algorithm": GROW, "samples": 1000, "settings": {"rate": [1.0, 3.0]}},
        {"controller": ["naive", "optimal"]},
    ]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "_train", wander)
        patch.setattr("cosim.studies.theta.scales", lambda _: {"theta g": 2.0, "theta h[0]": 1.0})
        return run_toy(folder, case=case, theta=theta)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return wandering(tmp_path_factory.mktemp("theta"), without=["h"], blocks=["h"])


def lines_of(results, number):
    _, header, lines = results.further()[number]
    return [dict(zip(header, line, strict=True)) for line in lines]


def test_theta_is_kept_where_the_log_has_it_last(results):
    with (results.folder / "theta.csv").open(newline="") as stream:
        rows = [row for row in csv.DictReader(stream) if row["training_seed"] == "1"]
    first = [row for row in rows if row["case"] == "go(rate=1.0)"]
    assert [row["samples"] for row in first] == ["0", "500", "800", "1000"]
    assert [float(row["theta g"]) for row in first] == [0.0, 12.0, 18.0, 20.0]


def test_the_course_is_in_scaled_entries_without_what_is_left_out(results):
    line = lines_of(results, 0)[0]
    # Of two seeds one goes 10, the other 20, in entries of scale 2.
    assert float(line["way, median"]) == pytest.approx(7.5)
    assert float(line["between seeds"]) == pytest.approx(5.0)


def test_two_cases_are_paired_by_training_seed(results):
    (line,) = lines_of(results, 1)
    assert line["cases"] == "go(rate=3.0) − go(rate=1.0)"
    assert float(line["of the way"]) == pytest.approx(1.0)
    # 20 and 40 in entries of scale 2; h goes the same way in both.
    assert float(line["‖Δθ‖, median"]) == pytest.approx(15.0)
    assert float(line["‖mean Δθ‖"]) == pytest.approx(15.0)
    assert float(line["by chance"]) == pytest.approx(np.std([10, 20], ddof=1) / 2**0.5, rel=1e-2)
    assert float(line["Δ h[0], mean [95 %]"].split()[0]) == 0
    cost = [results.of(f"go(rate={rate})", "paper").J.to_numpy() for rate in ("1.0", "3.0")]
    expected = np.mean(np.subtract(cost[1], cost[0]))
    assert float(line["ΔJ, mean [95 %]"].split()[0]) == pytest.approx(expected, rel=5e-2)
