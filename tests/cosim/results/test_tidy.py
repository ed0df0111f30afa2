import numpy as np
import pytest

from cosim.errors import ResultsError
from cosim.results.tidy import join, read

CSV = "controller,seed,J [1],note\nb,10,1.23456789012,x\nb,9,,y\na,9,-0.5,z\n"


def table(text=CSV):
    return read(text, ("controller", "seed"), ("note",), "table.csv")


def test_rows_are_sorted_by_key_and_numbers_have_eight_digits():
    assert table().to_csv() == "controller,seed,J [1]\na,9,-0.5\nb,9,\nb,10,1.2345679\n"


def test_reading_what_was_written_changes_nothing():
    once = table().to_csv()
    assert read(once, ("controller", "seed"), (), "table.csv").to_csv() == once


def test_an_empty_cell_is_undefined():
    assert np.isnan(table().signals["J"].values[1])


def test_the_unit_is_read_from_the_header():
    assert table().signals["J"].unit == "1"


def test_times_as_keys_are_rounded_like_numbers():
    found = read("time [s],x\n0.30000000000000004,1\n", ("time",), (), "t")
    assert found.rows == [("0.3",)]


def test_runs_are_joined_under_their_labels():
    joined = join({"two": table(), "one": table()})
    assert joined.keys == ("run", "controller", "seed")
    assert [row[0] for row in joined.rows] == ["one"] * 3 + ["two"] * 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("controller,J,note\na,1,\n", "table.csv has no column 'seed'"),
        ("controller,seed,J,note\na,1,2,\na,1,3,\n", "two rows .*'controller': 'a', 'seed': '1'"),
        ("controller,seed,J,note\na,1,two,\n", "column 'J': 'two' is no number"),
    ],
)
def test_a_malformed_table_is_refused(text, message):
    with pytest.raises(ResultsError, match=message):
        table(text)


def test_runs_with_other_signals_are_not_joined():
    other = read("controller,seed,K\na,1,2\n", ("controller", "seed"), (), "t")
    with pytest.raises(ResultsError, match="run 'b' has the signals K, another run J"):
        join({"a": table(), "b": other})
