"""One regret: on a plant that earns money all tables, files and figures agree in sign and value."""

import json

import numpy as np
import pytest

from controllers.factories import naive
from cosim import FmuPlant, evaluate, simulate
from cosim.core import statistics
from cosim.evaluation import judge
from cosim.studies.operation_result import operation_result

STEPS, SEEDS = 12, (3, 4)


@pytest.fixture
def profit(tmp_path):
    """A scenario whose optimum has a negative J: a stand-in for it has the greater profit."""
    (tmp_path / "profit.toml").write_text(
        'extends = "reactor"\nname = "profit"\n[plant.parameters]\nfixed_cost = 0.0\n'
        f"[penalty]\nlinear = {[1.0] * 2}\nquadratic = {[1e-3] * 2}\n"
    )
    return tmp_path / "profit.toml"


def test_an_evaluation_and_the_judge_of_the_same_runs_agree(profit, tmp_path, monkeypatch, cosim):
    from cosim import Scenario

    scenario = Scenario.load(profit)
    # The policy of the optimum takes minutes to solve here: another controller stands for it.
    monkeypatch.setattr("cosim.evaluation.stored_optimum", lambda _: "lqr")
    (tmp_path / "runs").mkdir()
    with FmuPlant(scenario) as plant:
        for seed in SEEDS:
            run = simulate(plant, naive(scenario), STEPS, seed)
            run.write_csv(tmp_path / "runs" / f"run-{seed}.csv")
    judged = judge(scenario, tmp_path / "runs")
    table = evaluate(scenario, ["naive"], SEEDS, STEPS)
    rows = table.to_pandas()
    assert (judged.optimum < 0).all(), "it earns money"
    assert np.sign(judged.regret).tolist() == np.sign(judged.J - judged.optimum).tolist()
    assert judged.regret.tolist() == pytest.approx(rows.regret.tolist(), rel=1e-12)
    code, out, err = cosim(
        "evaluate", "-s", profit, "--trajectories", tmp_path / "runs", "--out", "out", "--json"
    )
    assert code == 0, err
    found = json.loads(out)["regret"]["value"]
    wanted = statistics.regret(judged.J.to_numpy(), judged.optimum.to_numpy()).value
    assert found == pytest.approx(wanted, rel=1e-12)
    assert table.summary()["controllers"]["naive"]["regret"]["value"] == pytest.approx(found)


def test_the_tables_of_operation_take_the_same_regret():
    import pandas as pd

    key = {"training_seed": 0, "samples": 5}
    greedy = pd.DataFrame(
        [{"case": case, **key, "seed": 0, "J": J} for case, J in (("best", -10.0), ("a", -8.0))]
    )
    life = {"violating": 0.0, "dearest": -5.0, "first_change": 1.0, "updates": 1.0}
    life |= {"model_samples": 0.0, "dearer": 0.0, "excess": 1.0}
    lives = pd.DataFrame([greedy.loc[i, ["case", *key, "J"]].to_dict() | life for i in (0, 1)])
    (row,) = operation_result(lives, greedy, "best").runs.to_dict("records")
    assert row["regret"] == row["life_regret"] == pytest.approx(0.2)
    assert row["dearest"] == pytest.approx(0.5)
    assert row["excess"] == pytest.approx(0.1)
