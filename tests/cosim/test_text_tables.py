import pytest

from cosim.errors import CosimError
from cosim.files import write_atomically
from cosim.text_tables import cell, csv_text, markdown_table, read_csv, read_records


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, ""), (float("nan"), ""), (0.1 + 0.2, "0.30000000000000004"), (3, "3"), ("a", "a")],
)
def test_a_cell_reads_back_to_the_same_bits(value, text):
    assert cell(value) == text


def test_a_table_reads_back(tmp_path):
    text = csv_text(["name", "value"], [["a,b", "1"], ['say "c"', ""]])
    assert text == 'name,value\n"a,b",1\n"say ""c""",\n'
    path = write_atomically(tmp_path / "table.csv", text)
    assert read_csv(path, CosimError) == [["name", "value"], ["a,b", "1"], ['say "c"', ""]]
    assert read_records(path, CosimError)[1] == {"name": 'say "c"', "value": ""}


@pytest.mark.parametrize(
    ("content", "message"),
    [(b"", "is empty"), (b"\xff", "cannot be read"), (b"a,b\n1\n", "line 2: 1 fields, not 2")],
)
def test_a_damaged_table_is_one_message_with_the_file(tmp_path, content, message):
    path = tmp_path / "table.csv"
    path.write_bytes(content)
    with pytest.raises(CosimError, match=message) as caught:
        read_records(path, CosimError)
    assert "table.csv" in str(caught.value)


def test_a_markdown_table_has_text_left_and_numbers_right():
    assert markdown_table(["case", "J"], [["q", "1.5"]]) == (
        "| case | J |\n| --- | ---: |\n| q | 1.5 |\n"
    )
