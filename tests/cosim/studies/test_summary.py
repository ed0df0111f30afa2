"""Columns of runs.csv, summary.csv and aggregate.csv, of tables made by hand.

The values are arithmetic, or scipy's.
"""

from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from cosim import StudyResults

SEEDS = (100, 101)
BEST = 10.0


def results(costs, *, against=None, naive=20.0, status=None, scenarios=("paper",), optimum=BEST):
    """Results of runs with J by case, (R, S), the same on every scenario.

    The optimum costs `optimum` with each noise seed, `naive` likewise; `status` is by case and
    training seed, from 0.
    """
    noise = len(next(iter(costs.values()))[0])
    controllers = {"optimal": [[optimum] * noise], "naive": [[naive] * noise]}
    state, evaluation = [], []
    for scenario, (case, runs) in product(scenarios, {**controllers, **costs}.items()):
        trained = case in costs
        for run, row in enumerate(runs):
            key = {"scenario": scenario, "case": case, "training_seed": run if trained else None}
            said = (status or {}).get((case, run), "finished" if trained else "evaluated")
            state.append({**key, "status": said, "samples": 50 + run, "plant_samples": 60 + run})
            evaluation += [
                {
                    **key,
                    "seed": SEEDS[0] + s,
                    "steps": 1000,
                    "J": J,
                    "economic_cost": J - 1.0 - run,
                    "mean_violation": 0.1 * (run + s),
                    "violating_share": 0.01 * run,
                    "input_effort": 0.5,
                    "failures": run,
                }
                for s, J in enumerate(row)
            ]
    types = {"training_seed": "Int64"}
    cases = [
        {
            "name": name,
            "group": "baselines",
            "trained": name in costs,
            "samples": 50,
            "against": (against or {}).get(name),
        }
        for name in [*controllers, *costs]
    ]
    about = {
        "name": "hand-made",
        "title": "",
        "scenarios": list(scenarios),
        "cases": cases,
        "optimum": dict.fromkeys(scenarios, "optimal"),
        "naive": dict.fromkeys(scenarios, "naive"),
        "tables": [],
    }
    frames = (pd.DataFrame(state).astype(types), pd.DataFrame(evaluation).astype(types))
    return StudyResults(Path(), about, *frames, pd.DataFrame())


def row_of(table, case, scenario="paper"):
    (row,) = table[(table.case == case) & (table.scenario == scenario)].to_dict("records")
    return row


FOUR = [[14.0, 10.0], [11.0, 11.0], [13.0, 19.0], [12.0, 14.0]]  # regrets .2, .1, .6, .3


def test_a_run_s_regret_is_that_of_its_mean_with_student_s_interval_over_noise():
    runs = results({"a": FOUR}).runs_of("a", "paper")
    assert runs.J.tolist() == [12.0, 11.0, 16.0, 13.0]
    assert runs.regret.tolist() == pytest.approx([0.2, 0.1, 0.6, 0.3])
    low, high = stats.t.interval(0.95, 1, loc=0.6, scale=stats.sem([0.3, 0.9]))
    assert runs.regret_low.iloc[2] == pytest.approx(low)
    assert runs.regret_high.iloc[2] == pytest.approx(high)
    assert runs.gap_closed.tolist() == pytest.approx([0.8, 0.9, 0.4, 0.7])  # (20 − J)/(20 − 10)
    assert runs.economic_cost.tolist() == [11.0, 9.0, 13.0, 9.0]  # J − 1 − run
    assert runs.mean_violation.tolist() == pytest.approx([0.05, 0.15, 0.25, 0.35])
    assert runs.violating_share.tolist() == pytest.approx([0.0, 0.01, 0.02, 0.03])
    assert runs.failures.tolist() == [0, 2, 4, 6]


def test_a_summary_has_the_median_the_worst_and_the_interquartile_mean_of_the_runs():
    row = row_of(results({"a": FOUR}).summary, "a")
    assert row["regret_median"] == pytest.approx(0.25)  # of .2 and .3
    assert row["regret_worst"] == pytest.approx(0.6)
    assert row["regret_iqm"] == pytest.approx(stats.trim_mean([0.2, 0.1, 0.6, 0.3], 0.25))
    assert row["J_median"] == 12.5
    assert row["J_worst"] == 16.0
    assert row["J_iqm"] == 12.5
    assert row["gap_closed_median"] == pytest.approx(0.75)
    assert row["economic_cost"] == 10.0  # of 9, 9, 11, 13
    assert row["mean_violation"] == pytest.approx(0.2)
    assert row["violating_share"] == pytest.approx(0.015)
    assert row["failures"] == 12
    assert (row["runs"], row["finished"]) == (4, 4)
    assert (row["samples"], row["plant_samples"]) == (53, 63)


def test_the_median_run_s_interval_is_that_of_the_mean_of_both_middle_runs():
    row = row_of(results({"a": FOUR}).summary, "a")
    middle = (np.array(FOUR[0]) + np.array(FOUR[3])) / 2 / BEST - 1
    low, high = stats.t.interval(0.95, 1, loc=middle.mean(), scale=stats.sem(middle))
    assert (row["regret_median_low"], row["regret_median_high"]) == pytest.approx((low, high))


def quantiles(values):
    """Quantiles at 2.5 and 97.5 % of equally likely values, none of them near a jump."""
    values, counts = np.unique(np.round(values, 12), return_counts=True)
    below = np.cumsum(counts) / counts.sum()
    for level in (0.025, 0.975):
        assert np.abs(below - level).min() > 0.004, "the resampled quantile would be uncertain"
    return [float(values[np.searchsorted(below, level)]) for level in (0.025, 0.975)]


def test_the_wide_interval_is_of_runs_and_noise_drawn_independently():
    """Against all ways in which three runs and two noise seeds can be drawn."""
    costs = np.array([[11.0, 12.0], [13.0, 13.5], [16.0, 18.5]])
    row = row_of(results({"a": costs.tolist()}).summary, "a")
    medians = [
        float(np.median(costs[list(runs)][:, list(seeds)].mean(axis=1))) / BEST - 1
        for runs in product(range(3), repeat=3)
        for seeds in product(range(2), repeat=2)
    ]
    low, high = quantiles(medians)
    assert row["regret_wide_low"] == pytest.approx(low)
    assert row["regret_wide_high"] == pytest.approx(high)


def test_the_interval_of_the_interquartile_mean_is_of_runs_drawn_anew():
    """Against all ways in which two runs can be drawn."""
    row = row_of(results({"a": [[11.0, 11.0], [15.0, 15.0]]}).summary, "a")
    low, high = quantiles([0.1, 0.3, 0.3, 0.5])
    assert (row["regret_iqm_low"], row["regret_iqm_high"]) == pytest.approx((low, high))


def test_cases_share_a_rank_unless_the_difference_from_the_first_is_surely_positive():
    noise = np.array([-1.0, 1.0])
    first = 12.0 + noise + np.zeros((4, 1))
    surely = first + 1.0  # in each run and with each noise
    perhaps = surely + np.array([[0.5], [-0.4], [0.5], [-0.4]])  # a mean above, an interval about 0
    worst = first + 6.0
    costs = {"worst": worst, "perhaps": perhaps, "surely": surely, "first": first}
    table = results({name: cost.tolist() for name, cost in costs.items()}, naive=90.0).summary
    ranks = dict(zip(table.case, table["rank"], strict=True))
    assert list(ranks) == ["optimal", "first", "surely", "perhaps", "worst", "naive"]
    assert list(ranks.values()) == [1, 2, 3, 3, 5, 6]


def test_a_case_that_does_not_differ_from_the_leader_shares_its_rank():
    a = [[12.0, 14.0], [13.0, 15.0], [12.5, 14.5]]
    b = [[12.2, 14.2], [12.9, 14.9], [12.7, 14.7]]
    table = results({"a": a, "b": b}, naive=90.0).summary
    ranks = dict(zip(table.case, table["rank"], strict=True))
    assert ranks == {"optimal": 1, "a": 2, "b": 2, "naive": 4}


def test_what_was_trained_once_has_no_rank_and_moves_no_other_case_s():
    once = [[9.0, 9.0]]  # it seems to be the best, and its spread is unknown
    a = [[12.0, 12.1], [12.2, 12.0]]
    b = [[15.0, 15.1], [15.2, 15.0]]
    table = results({"once": once, "a": a, "b": b}, naive=90.0).summary
    assert list(table.case) == ["once", "optimal", "a", "b", "naive"]
    assert pd.isna(table["rank"].iloc[0])
    assert list(table["rank"].iloc[1:]) == [1, 2, 3, 4]


def printed(study, case):
    """Cells of a case's row of the printed table, by their headings."""
    header, rows = study.lines("paper")
    (row,) = [row for row in rows if row[0] == case]
    return dict(zip(header, row, strict=True))


def test_a_printed_regret_has_its_interval_over_trainings_and_noise_or_over_noise_alone():
    study = results({"four": FOUR, "once": [[11.0, 13.0]]})
    row = row_of(study.summary, "four")
    low, high = 100 * row["regret_wide_low"], 100 * row["regret_wide_high"]
    cells = printed(study, "four")
    assert cells["regret %, median [95 %]"] == f"25.0 [{low:.1f}, {high:.1f}]"
    # Regrets 0.3 and 0.9 with the two noise seeds of the worst run.
    half = stats.t.ppf(0.975, 1) * stats.sem([30.0, 90.0])
    assert cells["worst [95 %]"] == f"60.0 [{60 - half:.1f}, {60 + half:.1f}]"
    half = stats.t.ppf(0.975, 1) * stats.sem([10.0, 30.0])
    once = printed(study, "once")
    assert once["regret %, median [95 %]"] == f"20.0 [{20 - half:.1f}, {20 + half:.1f}]"
    assert (once["rank"], once["worst [95 %]"]) == ("", "")


def test_violations_a_week_are_the_share_of_its_samples_with_an_interval_over_both():
    """10 080 samples of a minute, of which runs 0 to 3 violate 0, 1, 2 and 3 %."""
    study = results({"four": FOUR, "once": [[11.0, 13.0]]})
    study.about["sampling_times"] = {"paper": 60.0}
    estimate = study.violations_per_week("four", "paper")
    assert estimate.value == pytest.approx(151.2)  # the median of 0, 100.8, 201.6 and 302.4
    # The share is the same with each noise seed: only the runs spread it.
    drawn = np.random.default_rng(1).integers(4, size=(4, 200_000))
    ends = np.quantile(np.median(100.8 * drawn, axis=0), [0.025, 0.975])
    assert estimate.interval == pytest.approx(ends, abs=51.0)
    assert printed(study, "four")["violations a week [95 %]"].startswith("151 [")
    assert printed(study, "once")["violations a week [95 %]"] == "0 [0, 0]"


def test_a_study_that_does_not_say_its_sampling_time_has_no_violations_a_week():
    assert "violations a week [95 %]" not in results({"four": FOUR}).lines("paper")[0]


SIX = np.array([0.5, -0.2, 0.9, 0.4, 0.7, -0.1])
"""Differences of six pairs of runs; their ranks differ."""


def test_a_paired_difference_is_the_pairs_median_with_p_of_the_signed_ranks():
    level = 14.0 + np.arange(6.0)[:, None]  # of the training seed: it cancels in pairs
    noise = np.array([-2.0, 2.0])
    b = level + noise
    a = b + SIX[:, None]
    costs = {"a": a.tolist(), "b": b.tolist()}
    row = row_of(results(costs, against={"a": "b"}, naive=90.0).summary, "a")
    assert row["against"] == "b"
    assert row["difference"] == pytest.approx(np.median(SIX) / BEST)
    assert row["difference_p"] == pytest.approx(stats.wilcoxon(SIX, method="exact").pvalue)
    assert row["difference_low"] < row["difference"] < row["difference_high"]
    drawn = SIX[np.indices([6] * 6).reshape(6, -1)]  # all ways to draw six pairs
    medians = np.median(drawn, axis=0) / BEST
    low, high = quantiles(medians)
    assert (row["difference_low"], row["difference_high"]) == pytest.approx((low, high))


def test_a_difference_has_the_sign_of_the_case_that_costs_more():
    costs = {"dear": [[13.0, 13.0], [14.0, 14.0]], "cheap": [[11.0, 11.0], [12.0, 12.0]]}
    against = {"dear": "cheap", "cheap": "dear"}
    table = results(costs, against=against).summary
    assert row_of(table, "dear")["difference"] == pytest.approx(0.2)
    assert row_of(table, "cheap")["difference"] == pytest.approx(-0.2)


def test_without_an_optimum_a_difference_is_relative_to_the_counterpart():
    costs = {"dear": [[13.0, 13.0], [14.0, 14.0]], "cheap": [[10.0, 10.0], [10.0, 10.0]]}
    study = results(costs, against={"dear": "cheap", "cheap": "dear"})
    study.about["optimum"].clear()
    table = study.summary
    assert row_of(table, "dear")["difference"] == pytest.approx(0.35)
    assert row_of(table, "dear")["difference_p"] == pytest.approx(0.5)
    assert row_of(table, "cheap")["difference"] == pytest.approx(-3.5 / 13.5)


def test_without_an_optimum_one_diverged_counterpart_leaves_the_difference_known():
    costs = {"a": [[9.0, 9.0]] * 3, "b": [[10.0, 10.0], [10.0, 10.0], [np.inf, np.inf]]}
    study = results(costs, against={"a": "b"})
    study.about["optimum"].clear()
    row = row_of(study.summary, "a")
    assert row["difference"] == pytest.approx(-0.1)
    assert row["difference_low"] == -np.inf
    assert row["difference_high"] == pytest.approx(-0.1)


def test_cases_without_a_training_seed_in_common_have_no_difference():
    costs = {"a": [[12.0, 12.0], [13.0, 13.0]], "b": [[11.0, 11.0], [11.5, 11.5]]}
    study = results(costs, against={"a": "b"})
    seeds = {0: 10, 1: 11}
    for frame in (study.state, study.evaluation):
        is_b = frame.case == "b"
        frame.loc[is_b, "training_seed"] = frame.training_seed[is_b].map(seeds)
    row = row_of(study.summary, "a")
    assert row["against"] == "b"
    assert np.isnan(row["difference"]) and np.isnan(row["difference_p"])
    assert printed(study, "a")["difference % [95 %]"] == ""


def test_a_diverged_run_counts_as_run_is_the_worst_and_is_not_finished():
    costs = {"a": [[12.0, 12.0], [np.inf, np.inf], [11.0, 11.0]]}
    found = results(costs, status={("a", 1): "diverged: at sample 7"})
    row = row_of(found.summary, "a")
    assert (row["runs"], row["finished"]) == (3, 2)
    assert row["regret_worst"] == np.inf
    assert row["regret_median"] == pytest.approx(0.2)


def test_an_aggregate_is_of_the_runs_of_all_scenarios_in_the_order_of_the_interquartile_mean():
    costs = {"a": FOUR, "b": [[11.0, 11.0]] * 4}
    found = results(costs, scenarios=("paper", "fouled"))
    table = found.aggregate
    assert table.case.tolist() == ["optimal", "b", "a", "naive"]
    (row,) = table[table.case == "a"].to_dict("records")
    regrets = [0.2, 0.1, 0.6, 0.3] * 2
    assert (row["scenarios"], row["runs"]) == (2, 8)
    assert row["regret_median"] == pytest.approx(np.median(regrets))
    assert row["regret_worst"] == pytest.approx(0.6)
    assert row["regret_iqm"] == pytest.approx(stats.trim_mean(regrets, 0.25))


def test_where_the_optimum_earns_money_a_regret_is_still_positive():
    row = row_of(
        results({"a": [[-8.0, -8.0], [-9.0, -9.0]]}, optimum=-10.0, naive=0.0).summary, "a"
    )
    assert row["regret_worst"] == pytest.approx(0.2)
    assert row["regret_median"] == pytest.approx(0.15)
