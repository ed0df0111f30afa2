"""Every column of the tables of operation, on costs made by hand: the values are arithmetic."""

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from controllers.factories import nmpc
from cosim import FmuPlant, study
from cosim.core.simulation import spawn_seeds
from cosim.core.training_options import TrainingOptions
from cosim.studies.operation import OPERATION_METRICS, SHIFT, compare_shifts, operation_metrics
from cosim.studies.operation_result import operation_result
from cosim.studies.operation_tables import OperationLayout, operation_tables
from learning.training_run import make_run
from tests.helpers.toy_study import case, document, toy_scenario

NOBODY = np.zeros(1000, dtype=bool)


def of_costs(cost, before=None, violating=NOBODY, first_change=0, samples=None):
    """Metrics of a run of which only the cost is of interest."""
    cost = np.asarray(cost, dtype=float)
    before = cost if before is None else np.asarray(before, dtype=float)
    samples = len(cost) if samples is None else samples
    return operation_metrics(samples, before, cost, violating, first_change)


def test_every_column_of_the_tables_is_a_metric_or_a_number_so_far():
    assert {*of_costs([1.0]), "updates", "model_samples"} == {"samples", *OPERATION_METRICS}


def test_j_is_the_mean_of_all_samples_so_far_those_before_the_first_change_too():
    cost = [10.0, 20.0, 30.0, 1000.0]
    assert of_costs(cost, first_change=2, samples=3)["J"] == 20.0
    assert of_costs(cost, first_change=2, samples=3)["samples"] == 3


def test_the_violating_share_is_of_the_samples_since_the_first_change():
    violating = np.array([True, True, True, False, True, False, False, True])
    assert of_costs(np.ones(8), violating=violating, first_change=3)["violating"] == 2 / 5
    assert of_costs(np.ones(8), violating=violating, first_change=3, samples=5)["violating"] == 0.5
    assert of_costs(np.ones(8), violating=violating)["violating"] == 5 / 8


def test_the_worst_window_is_the_largest_mean_of_100_samples_in_a_row():
    cost = np.full(500, 1.0)
    cost[250:260] = 11.0  # ten samples that cost 10 more: 100 more in a window of 100
    cost[0:100] = 50.0  # before the first change, so that it does not count
    assert of_costs(cost, first_change=100)["dearest"] == pytest.approx(2.0)
    assert of_costs(cost)["dearest"] == pytest.approx(50.0)
    assert of_costs(cost, first_change=100, samples=250)["dearest"] == pytest.approx(1.0)


def test_the_worst_window_may_lie_at_either_end():
    cost = np.ones(300)
    cost[-100:] = 3.0
    assert of_costs(cost)["dearest"] == pytest.approx(3.0)
    assert of_costs(cost[::-1])["dearest"] == pytest.approx(3.0)


def test_of_fewer_than_100_samples_the_worst_window_is_all_of_them():
    assert of_costs([1.0, 2.0, 6.0])["dearest"] == pytest.approx(3.0)


def test_the_first_change_is_told_only_once_it_has_come():
    assert np.isnan(of_costs(np.ones(5))["first_change"])
    assert of_costs(np.ones(5), first_change=4)["first_change"] == 4


def test_a_run_is_compared_with_the_start_from_the_first_change_on():
    before = np.zeros(3 * SHIFT)
    cost = np.zeros(3 * SHIFT)
    cost[:SHIFT] = 100.0  # not compared
    cost[SHIFT : 2 * SHIFT] = np.repeat([1.0, 3.0] * 4, SHIFT // 8)
    cost[2 * SHIFT :] = np.repeat([-2.0, 0.0] * 4, SHIFT // 8)
    row = of_costs(cost, before, np.zeros(len(cost), dtype=bool), SHIFT)
    assert row["dearer"] == 1  # the first shift since then, by 2 on average; the second is cheaper
    assert row["excess"] == 2.0


def test_while_theta_rests_nothing_is_compared():
    row = of_costs(np.ones(3 * SHIFT), violating=np.zeros(3 * SHIFT, dtype=bool))
    assert np.isnan(row["dearer"])
    assert np.isnan(row["excess"])


def test_a_shift_is_dearer_by_a_one_sided_t_test_of_its_eighths_corrected_for_their_number():
    """Against scipy: the excess of each eighth, at 5 % over the number of shifts."""
    shifts = 4
    eighths = np.array(
        [
            [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0],  # p = .0006
            [-1.0, 2.0, -1.5, 3.0, 1.0, 2.5, -2.0, 4.0],  # p = .11
            [-0.5, 2.0, 1.5, 3.0, -1.0, 2.5, 1.0, 0.5],  # p = .024: above .05 / 4
            [-1.0, -2.0, -3.0, -4.0, -5.0, -6.0, -7.0, -8.0],  # cheaper
        ]
    )
    p = stats.ttest_1samp(eighths, 0.0, axis=1, alternative="greater").pvalue
    assert ((p < 0.05) == [True, False, True, False]).all()
    cost = np.repeat(eighths.ravel(), SHIFT // 8)
    number, excess = compare_shifts(np.zeros(shifts * SHIFT), cost)
    assert number == (p < 0.05 / shifts).sum() == 1
    assert excess == 4.5


def lives(*rows):
    """Rows of operation.csv: case, training seed, samples, J; and further columns by name."""
    columns = ["case", "training_seed", "samples", "J"]
    frame = pd.DataFrame([dict(zip(columns, row, strict=False)) | row[4] for row in rows])
    return frame.reindex(columns=[*columns, *(name for name in OPERATION_METRICS if name != "J")])


def greedy(*rows):
    columns = ["case", "training_seed", "samples", "seed", "J"]
    return pd.DataFrame([dict(zip(columns, row, strict=True)) for row in rows])


@pytest.fixture
def found():
    """Two runs of `a` and of `b` against an optimum of 10 in the run and 20 on held-out noise."""
    run = lives(
        ("optimal", 1, 480, 10.0, {}),
        ("optimal", 2, 480, 8.0, {}),
        ("a", 1, 480, 12.0, {"dearest": 15.0, "excess": 1.0, "dearer": 2.0, "violating": 0.25}),
        ("a", 2, 480, 10.0, {"dearest": 24.0, "excess": 4.0, "dearer": 0.0, "violating": 0.5}),
        ("b", 1, 480, 11.0, {"dearest": 10.0, "excess": 0.0, "dearer": 0.0, "violating": 0.0}),
        ("b", 2, 480, 8.0, {"dearest": 8.0, "excess": 0.0, "dearer": 0.0, "violating": 0.0}),
    )
    held_out = greedy(
        ("optimal", None, 480, 7, 19.0),
        ("optimal", None, 480, 8, 21.0),
        ("a", 1, 480, 7, 21.0),
        ("a", 1, 480, 8, 23.0),
        ("a", 2, 480, 7, 29.0),
        ("a", 2, 480, 8, 31.0),
        ("b", 1, 480, 7, 20.0),
        ("b", 1, 480, 8, 21.0),
        ("b", 2, 480, 7, 20.0),
        ("b", 2, 480, 8, 22.0),
    )
    return operation_result(run, held_out, "optimal")


def test_regrets_of_a_run_are_against_the_optimum_on_the_same_noise(found):
    rows = found.runs.set_index(["case", "training_seed"])
    assert rows.regret["a", 1] == pytest.approx(22 / 20 - 1)
    assert rows.regret["a", 2] == pytest.approx(30 / 20 - 1)
    assert rows.life_regret["a", 1] == pytest.approx(12 / 10 - 1)
    assert rows.life_regret["a", 2] == pytest.approx(10 / 8 - 1)
    assert rows.dearest["a", 1] == pytest.approx(15 / 10 - 1)
    assert rows.dearest["a", 2] == pytest.approx(24 / 8 - 1)
    assert rows.excess["a", 1] == pytest.approx(1 / 10)
    assert rows.excess["a", 2] == pytest.approx(4 / 8)
    assert "optimal" not in rows.index.get_level_values("case")


def test_a_plant_that_earns_money_has_a_positive_regret_where_it_earns_less():
    run = lives(("optimal", 1, 480, -10.0, {}), ("a", 1, 480, -8.0, {"dearest": -5.0}))
    held_out = greedy(("optimal", None, 480, 7, -20.0), ("a", 1, 480, 7, -15.0))
    (row,) = operation_result(run, held_out, "optimal").runs.to_dict("records")
    assert row["regret"] == pytest.approx(0.25)
    assert row["life_regret"] == pytest.approx(0.2)
    assert row["dearest"] == pytest.approx(0.5)


def test_the_tables_show_medians_and_worst_runs_in_per_cent(found):
    layout = OperationLayout(60.0, [480])
    by_title = {
        title.partition(":")[0]: rows
        for title, _, rows in operation_tables(found, "paper", layout, {"a": "b", "b": None}, {})
    }
    regret, run, took, shifts, paired = by_title.values()
    # 10 % and 50 %; at the ends one run alone, 2 of 21 and 10 of 19, J* of one noise seed alone.
    assert regret[0] == ["a", "2", "30.0 [9.5, 52.6] (50.0)"]
    assert regret[1][:2] == ["b", "1"]
    assert regret[1][2].startswith("3.75 [")
    assert run[0] == ["a", "22.5 [20.0, 25.0] (25.0)"]  # 20 % and 25 %
    # case, runs, first change, violating %, of the 10 080 samples of a week, worst window %,
    # updates, model samples; no column of seconds, which are not there
    assert took[0] == ["a", "2", "", "37.50", "3780 [2520, 5040]", "125.0", "", ""]
    assert took[1][4] == "0 [0, 0]"
    assert shifts[0] == ["a", "2", "1 (2)", "30.00 (50.00)"]
    # J of a less that of b, a pair a training seed: 1.5 and 9 of 20
    assert paired[0][0] == "a − b"
    assert paired[0][1].startswith("26.2 [")
    assert paired[0][1].endswith("p 0.50")  # two pairs of the same sign, two-sided


def test_what_was_trained_once_has_no_rank_at_the_end_and_what_does_not_differ_shares_one():
    cases = {
        "once": [[1.0, 1.0]],
        "a": [[11.0, 12.0], [12.0, 13.0]],
        "b": [[11.5, 12.0], [11.7, 13]],
    }
    rows = [("optimal", None, 480, 7, 10.0), ("optimal", None, 480, 8, 10.0)]
    run = []
    for name, costs in cases.items():
        for seed, cost in enumerate(costs):
            rows += [(name, seed, 480, 7, cost[0]), (name, seed, 480, 8, cost[1])]
            run.append((name, seed, 480, 11.0, {}))
    result = operation_result(lives(*run), greedy(*rows), "optimal")
    title, header, table = next(
        operation_tables(result, "paper", OperationLayout(60, [480]), {}, {})
    )
    assert "median [95 %] (worst)" in title and header[1] == "rank at the end"
    assert {row[0]: row[1] for row in table} == {"once": "", "a": "1", "b": "1"}


def test_cases_without_a_training_seed_in_common_are_not_compared():
    """Whose noise differs: a difference of run by run would be another figure."""
    seeds = {"a": (1, 2), "b": (3, 4)}
    costs = {"a": 11.0, "b": 15.0}
    rows = [("optimal", None, 480, 7, 10.0), ("optimal", None, 480, 8, 10.0)]
    run = []
    for name, cost in costs.items():
        for seed in seeds[name]:
            rows += [(name, seed, 480, 7, cost), (name, seed, 480, 8, cost + 1.0)]
            run.append((name, seed, 480, cost, {}))
    result = operation_result(lives(*run), greedy(*rows), "optimal")
    assert result.ranks(480) == {"a": 1, "b": 1}
    tables = operation_tables(result, "paper", OperationLayout(60, [480]), {"a": "b"}, {})
    *_, (_, _, differences) = tables
    assert differences == [["a − b", ""]]


def in_operation(tmp_path, **settings):
    """Rows of operation.csv of the toy rule, which moves θ once in 100 samples."""
    changes = {
        "operation": {"hours": [1.0, 2.5, 5.0]},
        "training_seeds": {"first": 3, "count": 1},
        "evaluation": {"seeds": 1, "steps": 10},
        "curves": {"points": 1, "seeds": 1, "steps": 10},
        "case": [case("grow", settings=settings)],
    }
    study(document(**changes), tmp_path)
    table = pd.read_csv(tmp_path / "operation.csv")
    return table[table.case == "grow"].set_index("samples")


def test_the_first_change_counts_the_samples_before_it_and_their_cost_is_the_start_s(tmp_path):
    rows = in_operation(tmp_path, rate=10.0)
    assert rows.index.tolist() == [60, 150, 300]
    assert rows.first_change.isna().tolist() == [True, False, False]
    assert rows.first_change[150] == rows.first_change[300] == 100
    costs, violating = start_in_closed_loop(samples=60, seed=3)
    assert rows.J[60] == pytest.approx(np.mean(costs), rel=1e-9)
    assert rows.violating[60] == pytest.approx(np.mean(violating))


def start_in_closed_loop(samples, seed):
    """Costs of θ as it starts, and whether a bound is violated, in a loop of this test's own."""
    scenario = toy_scenario()
    run = make_run("fixed", scenario, samples, options=TrainingOptions(seed=seed))
    controller = nmpc(scenario, run.starting_parameters(), "rti")
    costs, violating = [], []
    with FmuPlant(scenario) as plant:
        s = plant.reset(spawn_seeds(seed)[0])
        for _ in range(samples):
            controller.prepare()
            action = controller.feedback(s).action
            below, above = scenario.state_lower - s, s - scenario.state_upper
            violating.append(max(below.max(), above.max()) > 1e-9)
            step = plant.step(np.clip(action, scenario.action_lower, scenario.action_upper))
            costs.append(step.stage_cost + step.penalty)
            s = step.s
    return costs, violating


def test_a_run_that_diverges_costs_infinitely_much_and_is_a_row_of_the_tables(tmp_path):
    changes = {
        "operation": {"hours": [1.0, 5.0]},
        "training_seeds": {"first": 3, "count": 1},
        "evaluation": {"seeds": 1, "steps": 10},
        "curves": {"points": 1, "seeds": 1, "steps": 10},
        "case": [case("lost", kind="Diverge")],
    }
    results = study(document(**changes), tmp_path)
    table = pd.read_csv(tmp_path / "operation.csv").query("case == 'lost'").set_index("samples")
    assert np.isfinite(table.J[60])
    assert table.J[300] == np.inf
    (run,) = results.runs_of("lost", "paper").to_dict("records")
    assert run["status"].startswith("diverged")
