import pytest

from cosim.errors import CosimError
from cosim.files import write_atomically
from cosim.text_tables import csv_text, read_csv


def test_a_table_reads_back(tmp_path):
    text = csv_text(["name", "value"], [["a,b", "1"], ['say "c"', ""]])
    assert text == 'name,value\n"a,b",1\n"say ""c""",\n'
    path = write_atomically(tmp_path / "table.csv", text)
    assert read_csv(path, CosimError) == [["name", "value"], ["a,b", "1"], ['say "c"', ""]]


@pytest.mark.parametrize(("content", "message"), [(b"", "is empty"), (b"\xff", "cannot be read")])
def test_a_damaged_table_is_one_message_with_the_file(tmp_path, content, message):
    path = tmp_path / "table.csv"
    path.write_bytes(content)
    with pytest.raises(CosimError, match=rf"table\.csv.*{message}"):
        read_csv(path, CosimError)
