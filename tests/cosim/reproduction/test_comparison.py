import numpy as np
import pytest

from cosim.evaluation import Evaluation
from cosim.evaluation.unit import Result
from cosim.reproduction.comparison import Table, against_converged, rows
from cosim.reproduction.report import like_paper, markdown

COSTS = {
    "naive": [100.0, 120.0, 110.0],
    "tuned": [80.0, 90.0, 85.0],
    "optimal": [50.0, 52.0, 51.0],
    "learned-0": [60.0, 66.0, 63.0],
    "learned-1": [52.0, 54.0, 53.0],
}


def evaluation():
    names = ("economic_cost", "mean_violation", "violating_share", "failures", "input_effort")
    results = {
        (name, seed): Result({"J": cost, **dict.fromkeys(names, 0.0)}, {})
        for name, costs in COSTS.items()
        for seed, cost in enumerate(costs)
    }
    return Evaluation(
        list(COSTS), [0, 1, 2], results, {}, {}, {}, reference="naive", optimum="optimal"
    )


def table():
    found = rows(evaluation(), {"learned": ["learned-0", "learned-1"]})
    return {row.controller: row for row in found}


def test_gains_are_ratios_of_means():
    tuned = table()["tuned"].estimates
    assert tuned["gain_over_naive"].value == pytest.approx(1 - 85 / 110)
    assert tuned["gap_closed"].value == pytest.approx((110 - 85) / (110 - 51))


def test_a_learner_s_figures_are_means_over_its_trainings():
    learned = table()["learned"]
    gaps = [(110 - cost) / (110 - 51) for cost in (63, 53)]
    assert learned.training_seeds == 2
    assert learned.estimates["gap_closed"].value == pytest.approx(np.mean(gaps))
    assert learned.worst_gap_closed == pytest.approx(min(gaps))


def test_a_learner_s_interval_is_over_its_trainings():
    low, high = table()["learned"].estimates["J"].t
    # Student's t of two values: mean ± 12.706 |a − b|/2.
    assert (low, high) == pytest.approx((58 - 12.7062 * 5, 58 + 12.7062 * 5), rel=1e-5)


def test_the_csv_has_eight_digits_and_empty_cells_for_what_is_undefined():
    made = Table()
    made.add(rows(evaluation(), {"learned": ["learned-0"], "other": ["learned-1"]}), {"law": "x"})
    header, first, *_, last = made.to_csv().splitlines()
    cells = dict(zip(header.split(","), first.split(","), strict=True))
    assert cells["law"] == "x"
    assert cells["gap_closed"] == "0"
    one = dict(zip(header.split(","), last.split(","), strict=True))
    assert (one["J"], one["J_low"]) == ("53", "")
    assert one["gain_over_naive"] == f"{1 - 53 / 110:.8g}"


def test_converged_is_compared_seed_by_seed():
    (record,) = against_converged(evaluation(), {"naive": "tuned"}).records
    differences = np.array(COSTS["tuned"]) - np.array(COSTS["naive"])
    assert float(record["J_difference"]) == pytest.approx(differences.mean())
    assert float(record["J_difference_high"]) < 0


@pytest.mark.parametrize(
    ("naive", "tuned", "found"),
    [("0.22", "0.16", ["(a)", "(b)"]), ("0.22", "0.5", ["(a)"]), ("0.5", "", [])],
)
def test_a_reading_is_like_the_paper_where_its_gains_are(naive, tuned, found):
    assert like_paper({"gain_over_naive": naive, "gain_over_tuned": tuned}) == found


def test_markdown_has_a_rule_below_its_header():
    assert markdown([["a", "b"], ["1", "2"]]) == "| a | b |\n| --- | ---: |\n| 1 | 2 |"
