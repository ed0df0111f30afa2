import numpy as np
import pytest

from cosim.errors import ResultsError
from cosim.results.check import differences, stored_table
from cosim.results.experiments import Experiment, Tolerance
from cosim.results.tidy import read

TOLERANCES = {
    "X2": Tolerance(absolute=1e-3, unit="%"),
    "P2": Tolerance(absolute=1e-1, unit="kPa"),
}


def table(x2=(25.0, 26.0, 27.0), p2=(50.0, 51.0, 52.0), time=(0, 60, 120)):
    rows = "".join(f"naive,{t},{x},{p}\n" for t, x, p in zip(time, x2, p2, strict=True))
    return read(f"run,time [s],X2 [%],P2 [kPa]\n{rows}", ("run", "time"), (), "table")


def test_equal_tables_do_not_differ():
    assert differences("e", table(), table(), TOLERANCES) == []


def test_a_difference_below_its_tolerance_is_none():
    assert differences("e", table(), table(x2=(25.0, 26.0009, 27.0)), TOLERANCES) == []


def test_each_signal_has_its_own_tolerance():
    assert differences("e", table(), table(p2=(50.0, 51.05, 52.0)), TOLERANCES) == []
    assert differences("e", table(), table(x2=(25.0, 26.05, 27.0)), TOLERANCES) != []


def test_the_first_row_that_differs_is_named_with_signal_values_and_unit():
    now = table(x2=(25.0, 26.01, 27.5), p2=(50.0, 51.0, 52.5))
    first, second = differences("e", table(), now, TOLERANCES)
    assert first == (
        "e: row run=naive, time=60: signal X2 is 26.01 now, 26.0 stored: 0.01 apart, "
        "tolerance 0.001 %"
    )
    assert second == "e: row run=naive, time=120: signal P2 differs from here on"


def test_undefined_against_a_number_differs():
    (line,) = differences("e", table(), table(x2=(25.0, "", 27.0)), TOLERANCES)
    assert "X2 is nan now, 26.0 stored" in line


def test_undefined_on_both_sides_is_the_same():
    both = [table(x2=(25.0, "", 27.0)) for _ in range(2)]
    assert np.isnan(both[0].signals["X2"].values[1])
    assert differences("e", *both, TOLERANCES) == []


def test_a_row_that_is_gone_or_new_is_named():
    longer = table(x2=(25.0,) * 4, p2=(50.0,) * 4, time=(0, 60, 120, 180))
    assert "time=180 is stored but not computed" in differences("e", longer, table(), TOLERANCES)[0]
    assert "time=180 is computed but not stored" in differences("e", table(), longer, TOLERANCES)[0]


def test_a_signal_without_tolerance_is_refused():
    with pytest.raises(ResultsError, match=r"signal 'P2' has no tolerance; .* tolerances\.toml"):
        differences("e", table(), table(), {"X2": TOLERANCES["X2"]})


def test_a_pattern_covers_the_signals_it_fits():
    stored, now = (read(f"run,theta B\na,{v}\n", ("run",), (), "t") for v in (1.0, 1.2))
    wide = {"theta *": Tolerance(absolute=0.5, unit="")}
    assert differences("e", stored, now, wide) == []
    exact = wide | {"theta B": Tolerance(absolute=0.1, unit="")}
    assert differences("e", stored, now, exact) != []


def test_a_tolerance_in_another_unit_is_refused():
    wrong = TOLERANCES | {"P2": Tolerance(absolute=1.0, unit="bar")}
    with pytest.raises(ResultsError, match=r"'P2' is in kPa, its tolerance .* in 'bar'"):
        differences("e", table(), table(), wrong)


EXPERIMENT = Experiment(
    title="t", runs={"naive": "cosim simulate -n 3"}, table="trajectory.csv", keys=("time",)
)


def test_a_missing_reference_fails_and_is_not_written(tmp_path):
    with pytest.raises(ResultsError, match="missing; make it with: cosim results update e"):
        stored_table(tmp_path, "e", EXPERIMENT)
    assert list(tmp_path.iterdir()) == []


def test_a_reference_edited_by_hand_fails(tmp_path):
    (tmp_path / "e").mkdir()
    path = tmp_path / "e" / "trajectory.csv"
    path.write_text(table().to_csv())
    stored_table(tmp_path, "e", EXPERIMENT)
    path.write_text(table().to_csv().replace("26", "26.000000001"))
    with pytest.raises(ResultsError, match="not of 8 digits"):
        stored_table(tmp_path, "e", EXPERIMENT)
