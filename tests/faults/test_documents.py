"""Every kind of hostile document, for every reader of TOML: its own error, in one line."""

import os
import threading

import pytest

from controllers import Parameters, Problem
from controllers.errors import ParameterError
from cosim import Scenario, Study
from cosim.errors import ScenarioError, StudyError
from cosim.files import LARGEST
from cosim.scenario import LONGEST


def theta(path):
    return Parameters.load(path, Problem.from_scenario(Scenario.load("nominal")))


READERS = {
    "scenario": (Scenario.load, ScenarioError),
    "study": (Study.load, StudyError),
    "theta": (theta, ParameterError),
}
CONTENTS = {
    "a number of 5000 digits": b"schema = " + b"9" * 5000,
    "lists within lists without end": b"schema = " + b"[" * 5000 + b"]" * 5000,
    "not UTF-8": b"name = '\xff'",
    "nothing": b"",
    "a date": b"schema = 2026-01-01",
    "a lone surrogate": b'name = "\\ud800"',
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("content", CONTENTS)
def test_a_hostile_document_is_refused_in_a_line(tmp_path, reader, content):
    read, error = READERS[reader]
    path = tmp_path / "document.toml"
    path.write_bytes(CONTENTS[content])
    with pytest.raises(error) as caught:
        read(path)
    assert len(str(caught.value)) < 2000
    assert "document.toml" in str(caught.value)


@pytest.mark.parametrize("reader", READERS)
def test_a_fifo_does_not_block(tmp_path, reader):
    read, error = READERS[reader]
    path = tmp_path / "fifo.toml"
    os.mkfifo(path)
    caught = []

    def attempt():
        try:
            read(path)
        except error as refused:
            caught.append(str(refused))

    thread = threading.Thread(target=attempt, daemon=True)
    thread.start()
    thread.join(20.0)
    assert caught


def test_a_document_beyond_any_of_ours_is_not_even_parsed(tmp_path):
    path = tmp_path / "large.toml"
    path.write_bytes(b"#" * (LARGEST + 1))
    with pytest.raises(ScenarioError, match="more than any document of ours"):
        Scenario.load(path)


def test_a_chain_of_extends_has_an_end(tmp_path):
    for number in range(LONGEST + 3):
        (tmp_path / f"{number}.toml").write_text(f'extends = "{number + 1}.toml"')
    (tmp_path / f"{LONGEST + 3}.toml").write_text('extends = "paper"')
    with pytest.raises(ScenarioError, match=f"more than {LONGEST} times"):
        Scenario.load(tmp_path / "0.toml")
