import pytest

from cosim.cli.benchmark.figures import figure, show
from cosim.cli.output import Output


def test_a_ratio_is_the_median_of_the_pairs_and_not_of_the_medians():
    row = figure("ours", [1e-6, 2e-6, 4e-6], "theirs", [3e-6, 4e-6, 40e-6])
    assert row["median_us"] == pytest.approx(2.0)
    assert row["minimum_us"] == pytest.approx(1.0)
    assert row["reference_median_us"] == pytest.approx(4.0)
    assert row["ratio"] == pytest.approx(3.0)
    assert row["met"] is None


def test_a_bound_holds_on_time_or_on_ratio():
    assert figure("ours", [2e-6], at_most=2.5)["met"] is True
    assert figure("ours", [2e-6], at_most=1.5)["met"] is False
    assert figure("ours", [2e-6], "theirs", [4e-6], at_least=1.9)["met"] is True
    assert figure("ours", [2e-6], "theirs", [4e-6], at_least=2.1)["met"] is False


def test_readings_without_their_pair_are_refused():
    with pytest.raises(ValueError, match="zip"):
        figure("ours", [1e-6, 2e-6], "theirs", [3e-6])


def test_the_table_says_what_a_figure_was_measured_beside(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    rows = [figure("ours", [2e-6], "theirs", [4e-6], at_least=2.1), figure("alone", [1e-6])]
    show("speed", rows, Output(as_json=False))
    out = capsys.readouterr().out
    first = next(line for line in out.splitlines() if "ours" in line)
    assert "theirs" in first
    assert "2.00" in first
    assert "MISSED" in first
