import os

import pytest

from cosim.errors import CosimError
from cosim.files import (
    cell,
    csv_text,
    markdown_table,
    read_csv,
    read_records,
    user_cache,
    write_atomically,
)


def test_what_stood_there_survives_a_failure(tmp_path, monkeypatch):
    path = write_atomically(tmp_path / "file", "old θ")
    monkeypatch.setattr(os, "fsync", lambda _: (_ for _ in ()).throw(OSError("disk full")))
    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, "new")
    assert path.read_text("utf-8") == "old θ"
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_the_cache_is_the_one_that_the_controllers_use(tmp_path, monkeypatch):
    from controllers import storage

    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    assert user_cache("fmus") == storage.user_cache("fmus") == tmp_path / "fmus"


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


def test_pieces_are_written_as_they_come_and_a_failure_between_them_leaves_nothing(tmp_path):
    path = write_atomically(tmp_path / "file", (f"{i}\n" for i in range(3)))
    assert path.read_text() == "0\n1\n2\n"

    def broken():
        yield "half"
        raise RuntimeError("no more")

    with pytest.raises(RuntimeError, match="no more"):
        write_atomically(path, broken())
    assert path.read_text() == "0\n1\n2\n"
    assert list(tmp_path.iterdir()) == [path]
