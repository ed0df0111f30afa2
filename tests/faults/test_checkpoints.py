"""A checkpoint whose checksum fits, but whose content is not that of the run, is refused."""

import numpy as np
import pytest

from controllers.errors import ControllerError
from cosim import FmuPlant
from learning import checkpoint
from learning.errors import LearningError
from learning.q_learning import QLearning
from learning.training import _Session
from tests.helpers.training import make_run, train

RUN = make_run()


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    folder = tmp_path_factory.mktemp("good")
    train(RUN, folder)
    return checkpoint.load(folder / "checkpoint.npz")


@pytest.fixture(scope="module")
def resume(tmp_path_factory):
    """Take up a checkpoint with a content and a checksum that fits it, always in one run."""
    folder = tmp_path_factory.mktemp("resumed")
    with FmuPlant(RUN.scenario) as plant:
        session = _Session(RUN, QLearning, plant, folder)

        def attempt(content):
            checkpoint.save(folder / "checkpoint.npz", content)
            session.load()

        yield attempt


ENTRIES = ("plant", "rows", "row_thetas", "theta")
STATE = ("counts", "totals", "generator", "algorithm_generator", "columns")
HARM = {
    "none": lambda a: np.zeros(0),
    "one row too many": lambda a: np.concatenate([a, a[:1]]),
    "one row too few": lambda a: a[:-1],
    "text": lambda a: np.array(["text"]),
    "another order of dimensions": lambda a: np.asarray(a)[..., None],
}
WORDS = {
    "nothing": None,
    "a text": "text",
    "a number": 1e400,
    "a list": [1, [2]],
    "a table": {"a": {}},
    "an empty table": {},
}


def test_the_good_one_is_taken_up(resume, good):
    resume(good)


def refused(resume, content):
    with pytest.raises((LearningError, ControllerError)) as caught:
        resume(content)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("entry", ENTRIES)
def test_a_missing_entry_is_refused(resume, good, entry):
    arrays = {name: array for name, array in good.arrays.items() if name != entry}
    refused(resume, checkpoint.Checkpoint(good.run, good.state, arrays))


@pytest.mark.parametrize("entry", ENTRIES)
@pytest.mark.parametrize("harm", HARM)
def test_an_entry_of_another_form_is_refused(resume, good, entry, harm):
    arrays = dict(good.arrays) | {entry: HARM[harm](good.arrays[entry])}
    if entry == "plant" and harm == "another order of dimensions":
        pytest.skip("bytes have no dimensions")
    refused(resume, checkpoint.Checkpoint(good.run, good.state, arrays))


@pytest.mark.parametrize("key", STATE)
@pytest.mark.parametrize("word", WORDS)
def test_a_state_of_another_form_is_refused(resume, good, key, word):
    if key == "totals" and word == "an empty table":
        pytest.skip("totals of no sample")
    state = dict(good.state) | {key: WORDS[word]}
    refused(resume, checkpoint.Checkpoint(good.run, state, good.arrays))


@pytest.mark.parametrize("key", STATE)
def test_a_missing_state_is_refused(resume, good, key):
    state = {name: value for name, value in good.state.items() if name != key}
    refused(resume, checkpoint.Checkpoint(good.run, state, good.arrays))


@pytest.mark.parametrize("key", ["run", "state"])
@pytest.mark.parametrize("word", WORDS)
def test_an_account_of_another_form_is_refused(resume, good, key, word):
    if key == "state" and isinstance(WORDS[word], dict):
        pytest.skip("a state that lacks its parts: above")
    content = {"run": good.run, "state": good.state} | {key: WORDS[word]}
    refused(resume, checkpoint.Checkpoint(arrays=good.arrays, **content))


ACCOUNTS = [b"", b"{", b"[]", b"null", b"\xff", b"1", b"[" * 9999, b'{"a":1}']


@pytest.mark.parametrize("account", ACCOUNTS)
def test_an_account_that_is_none_is_refused(good, tmp_path, account):
    entries = dict(good.arrays) | {"about": np.frombuffer(account, dtype=np.uint8)}
    entries["digest"] = np.frombuffer(checkpoint._digest(entries), dtype=np.uint8)
    np.savez(tmp_path / "checkpoint.npz", allow_pickle=False, **entries)
    with pytest.raises(LearningError) as caught:
        checkpoint.load(tmp_path / "checkpoint.npz")
    assert "\n" not in str(caught.value)
