"""A checkpoint whose checksum fits, but whose content is not that of the run, is refused."""

import numpy as np
import pytest

from controllers.errors import ControllerError
from cosim import FmuPlant
from learning import QLearning, checkpoint
from learning.checkpoint import Checkpoint
from learning.errors import LearningError
from learning.training import _Session
from tests.helpers.training import make_run, train

RUN = make_run()
ENTRIES = ("plant", "rows", "row_thetas", "theta")
STATE = ("counts", "totals", "generator", "algorithm_generator", "columns")
HARM = (lambda a: np.zeros(0), lambda a: a[:-1], lambda a: np.array(["text"]))


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

        def attempt(state, arrays):
            checkpoint.save(folder / "checkpoint.npz", Checkpoint(session.identity, state, arrays))
            session.load()

        yield attempt


def test_the_good_one_is_taken_up_and_others_are_refused_in_a_line(resume, good):
    resume(good.state, good.arrays)
    missing = [(good.state, {k: v for k, v in good.arrays.items() if k != e}) for e in ENTRIES]
    missing += [({k: v for k, v in good.state.items() if k != key}, good.arrays) for key in STATE]
    wrong = [(good.state, good.arrays | {e: h(good.arrays[e])}) for e in ENTRIES for h in HARM]
    wrong += [(good.state | {key: word}, good.arrays) for key in STATE for word in (None, "text")]
    for state, arrays in (*missing, *wrong):
        with pytest.raises((LearningError, ControllerError)) as caught:
            resume(state, arrays)
        assert "\n" not in str(caught.value)
