import json

import pytest

from cosim.files import DEEPEST, LARGEST, read_json, read_toml

READERS = {"json": read_json, "toml": read_toml}
BAD = {
    "missing": (None, "does not exist"),
    "no text": (b"\xff\xfe", "is not UTF-8 text"),
    "no document": (b"{ [", "is not valid"),
    "too large": (b" " * (LARGEST + 1), "more than any document of ours"),
}


@pytest.mark.parametrize("reader", READERS.values(), ids=READERS)
@pytest.mark.parametrize("case", BAD)
def test_a_bad_file_is_one_message_that_names_it(tmp_path, reader, case):
    content, message = BAD[case]
    path = tmp_path / "file"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(KeyError, match=f"the file {message}|the file.*{message}"):
        reader(path, "the file", KeyError)
    with pytest.raises(KeyError, match="the file is not a regular file"):
        reader(tmp_path, "the file", KeyError)


@pytest.mark.parametrize("text", ["[1, 2]", "1.0", "null"])
def test_json_that_is_no_object_is_refused(tmp_path, text):
    (tmp_path / "file").write_text(text)
    with pytest.raises(KeyError, match="is not a JSON object"):
        read_json(tmp_path / "file", "the file", KeyError)


def test_json_nested_without_end_is_refused_and_as_deep_as_allowed_is_read(tmp_path):
    path = tmp_path / "file"
    document = {"a": 1}
    for _ in range(DEEPEST - 1):
        document = {"a": document}
    path.write_text(json.dumps(document))
    assert read_json(path, "the file", KeyError) == document
    for text in (json.dumps({"a": document}), "[" * 100_000):
        path.write_text(text)
        with pytest.raises(KeyError, match=f"more than {DEEPEST} deep|not valid JSON"):
            read_json(path, "the file", KeyError)
