import numpy as np
import pandas as pd
from scipy.signal import lfilter

from cosim import Study, study
from cosim.studies.operation import OPERATION_METRICS, SHIFT, compare_shifts, plant_at
from cosim.studies.operation_result import operation_result
from cosim.studies.operation_tables import OperationLayout, operation_tables
from tests.helpers.toy_study import GROW, SCENARIO


def test_noise_alone_makes_no_shift_dearer_and_a_dearer_one_is_found(rng):
    before = rng.gamma(2.0, 100.0, (200, 21 * SHIFT))
    cost = before + rng.normal(0.0, 50.0, before.shape)
    called = [compare_shifts(*pair)[0] > 0 for pair in zip(before, cost, strict=True)]
    assert np.mean(called) < 0.1  # 5 % of lives
    cost[0, 480:960] += 25.0
    number, excess = compare_shifts(before[0], cost[0])
    assert number == 1 and abs(excess - 25.0) < 10.0


def test_noise_with_a_memory_is_compared_in_longer_parts(rng):
    memory = 24.0
    phi = np.exp(-1.0 / memory)
    shape = (200, 3 * SHIFT)
    cost = lfilter([np.sqrt(1 - phi**2)], [1.0, -phi], rng.normal(0.0, 50.0, shape))
    before = np.zeros(shape)

    def called(**told):
        lives = zip(before, cost, strict=True)
        return np.mean([compare_shifts(*pair, **told)[0] > 0 for pair in lives])

    assert called(memory=memory) < 0.09 < called()  # 5 % of lives, and 13 %
    assert np.isnan(compare_shifts(before[0], cost[0], memory=100.0)[0])


def test_a_run_that_diverged_is_dearer_in_each_shift_since():
    cost = np.ones(4 * SHIFT)
    cost[SHIFT:] = np.inf
    assert compare_shifts(np.ones(4 * SHIFT), cost) == (3.0, np.inf)
    assert np.isnan(compare_shifts(cost[:10], cost[:10])).all()


def test_a_study_in_operation_without_a_training_has_a_report(tmp_path):
    document = {"schema": 1, "name": "fixed", "scenarios": ["paper"], "operation": {"hours": [1]}}
    document["scenario"] = [SCENARIO]
    document |= {"case": [{"controller": "naive"}], "evaluation": {"seeds": 2, "steps": 10}}
    assert study(document | {"curves": {"seeds": 2, "steps": 10}}, tmp_path).report().is_file()


def test_a_study_in_operation_keeps_a_log_without_a_picture_of_it(tmp_path):
    document = {"schema": 1, "name": "fixed", "scenarios": ["paper"], "operation": {"hours": [1]}}
    document["scenario"] = [SCENARIO]
    document |= {"case": [{"name": "h", "algorithm": "fixed"}], "training_seeds": {"count": 1}}
    document |= {"evaluation": {"seeds": 1, "steps": 20}, "curves": {"seeds": 2, "steps": 10}}
    study(document | {"logs": ["h"]}, tmp_path)
    assert (tmp_path / "logs" / "paper-h.csv").is_file()


def test_in_operation_theta_is_evaluated_on_the_noise_of_the_comparison(tmp_path):
    """Without [curves]. θ at the last time is the final one, on the same plant and noise."""
    document = {"schema": 1, "name": "one", "scenarios": ["paper"], "operation": {"hours": [1, 2]}}
    document["scenario"] = [SCENARIO]
    document["training_seeds"] = {"count": 1}
    document["evaluation"] = {"first_seed": 50, "seeds": 2, "steps": 20, "burn_in": 5}
    document["case"] = [{"name": "grow", "algorithm": GROW}]
    results = study(document, tmp_path)
    evaluated = results.evaluation[results.evaluation.case == "grow"]
    greedy = pd.read_csv(tmp_path / "greedy.csv")
    greedy = greedy[greedy.case == "grow"]
    at_the_end = greedy[greedy.samples == 120]
    assert list(at_the_end.seed) == [50, 51]
    assert list(at_the_end.J) == list(evaluated.J)
    assert list(greedy[greedy.samples == 60].J) != list(evaluated.J)
    assert "Learning curves" not in results.report().read_text()


def test_with_a_table_curves_theta_in_operation_meets_its_noise_after_the_same_burn_in():
    document = {"schema": 1, "name": "one", "scenarios": ["paper"], "operation": {"hours": [1]}}
    document["evaluation"] = {"first_seed": 50, "seeds": 2, "steps": 20, "burn_in": 5}
    document["case"] = [{"controller": "naive"}]
    document["curves"] = {"seeds": 3, "steps": 10}
    noise = Study.from_dict(document).noise_at_marks("paper")
    assert (len(noise.seeds), noise.steps, noise.burn_in) == (3, 10, 5)


def test_cases_with_other_training_seeds_are_compared_on_those_that_both_have():
    runs = {"optimal": [10.0, 10.0, 10.0], "a": [11.0, 11.0, 90.0], "b": [10.5, 10.5]}
    rows = [
        {"case": case, "training_seed": seed, "samples": 10, "J": J}
        for case, costs in runs.items()
        for seed, J in enumerate(costs)
    ]
    greedy = [row | {"seed": noise} for row in rows for noise in (5, 6)]
    lives = pd.DataFrame([dict.fromkeys(OPERATION_METRICS, 0.0) | row for row in rows])
    found = operation_result(lives, pd.DataFrame(greedy), "optimal")
    layout = OperationLayout(60.0, [10])
    *_, (_, _, ((pair, difference),)) = operation_tables(
        found, "paper", layout, {"a": "b", "b": None}, {}
    )
    assert pair == "a − b"
    assert difference.startswith("5.00")


def test_theta_is_evaluated_on_the_plant_as_it_is_then(paper):
    change = {"time": 1800.0, "parameters": {"UA2": 5.2}}
    scenario = paper.replace({"plant": {"changes": [change]}})
    assert "UA2" not in plant_at(scenario, 1740.0).plant.parameters
    assert plant_at(scenario, 1800.0).plant.parameters["UA2"] == 5.2
