"""Wrong kinds at every door, of documents, options, returned values and files: one line each."""

import copy
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controllers.factories import naive
from cosim import Decision, FmuPlant, Scenario, Study, evaluate, simulate, train
from cosim.core.errors import CosimError
from cosim.core.training_options import TrainingOptions
from cosim.evaluation import judge
from learning.training_run import make_run
from tests.helpers.loop import Proportional
from tests.helpers.toy_study import case, document

PAPER = Scenario.load("paper")
ODD = [
    None, True, -1, 0, 1.5, 2**70, 1e300, 1j, float("nan"), float("inf"), "", "x", "a\nb", "\0",
    [], [[]], [1.0], {}, {"a": 1}, np.zeros(2), np.array("a"), object(),
]  # fmt: skip
ANY = st.sampled_from(ODD)
TRAINED = {
    "name": "g", "settings": {"rate": [1.0]}, "start": "naive", "nmpc": "rti", "against": "naive",
    "training": {"log_every": 10, "divergence": 2.0, "evaluation_seeds": 1, "rest_after": 5},
}  # fmt: skip
STUDY = document(
    operation={"hours": {"default": [1.0]}, "columns": [1.0], "drawn": ["g"]},
    case=[case("g") | TRAINED, {"controller": ["naive"]}],
    trajectory=[{"name": "t", "seed": 1, "steps": 3, "cases": ["naive"]}],
    scenario=[{"extends": "paper", "name": "own"}],
    depends_on=[],
)


def accepted(attempt):
    """Whether the attempt is accepted; it may be refused, but in one line."""
    try:
        attempt()
    except CosimError as error:
        assert "\n" not in str(error)
        return False
    return True


def places(document, path=()):
    """Paths of all values of a document."""
    inner = document.items() if isinstance(document, dict) else ()
    for key, value in enumerate(document) if isinstance(document, list) else inner:
        yield (*path, key)
        yield from places(value, (*path, key))


@pytest.mark.slow
@settings(max_examples=60)
@given(st.sampled_from(list(places(STUDY))), ANY)
def test_a_study_with_any_value_anywhere(path, value):
    changed = copy.deepcopy(STUDY)
    table = changed
    for key in path[:-1]:
        table = table[key]
    table[path[-1]] = value

    def attempt():
        study = Study.from_dict(changed)
        for scenario in study.scenarios:
            study.noise(scenario)
            for one in study.cases:
                if one.algorithm is not None:
                    study.training(one, scenario, 0, None).make_run(study.scenarios[scenario])

    accepted(attempt)


@settings(max_examples=60)
@given(st.sampled_from([*Decision._fields, "solution"]), ANY, st.booleans())
def test_a_controller_that_returns_anything(field, value, named):
    class Odd(Proportional):
        def feedback(self, s, a=None):
            kind = Decision if named else SimpleNamespace
            fields = super().feedback(s)._asdict() | {field: value}
            return value if field == "solution" else kind(**fields)

    with FmuPlant(PAPER) as plant:
        accepted(lambda: simulate(plant, Odd(PAPER), 2, 0).to_csv())


@pytest.mark.slow
@settings(max_examples=60)
@given(st.sampled_from(["scenario", "controllers", "factory", "seeds", "steps", "jobs"]), ANY)
def test_an_evaluation_of_anything(name, value):
    options = {"scenario": PAPER, "controllers": {"m": Proportional}, "seeds": 1, "steps": 2}
    options |= {"controllers": {"m": value}} if name == "factory" else {name: value}
    accepted(lambda: evaluate(**options))


OPTIONS = ("seed", "start", "controller", "log_every", "divergence", "settings", "rest_after")


@settings(max_examples=60)
@given(st.sampled_from(OPTIONS), ANY)
def test_a_training_with_any_option(name, value):
    hyperparameters, options = (value, {}) if name == "settings" else (None, {name: value})
    options = TrainingOptions(**options)
    accepted(lambda: make_run("q-learning", PAPER, 10, hyperparameters, options))


def test_a_training_seed_is_no_held_out_one():
    with pytest.raises(CosimError, match="held out"):
        train("q-learning", PAPER, 10, seed=1_000_000)


@pytest.fixture(scope="module")
def checkpointed(tmp_path_factory):
    """Give the arguments of a finished training, and its checkpoint."""
    out = tmp_path_factory.mktemp("training")
    every = {"log_every": 10, "evaluate_every": 10, "checkpoint_every": 10}
    few = {"evaluation_seeds": 1, "evaluation_steps": 2}
    arguments = {"samples": 10, "out": out, **every, **few}
    train("q-learning", PAPER, **arguments)
    with np.load(out / "checkpoint.npz") as archive:
        return arguments, dict(archive)


FORGED = {
    "gone": lambda entry: None,
    "no number": lambda entry: np.array(float("nan")),
    "another shape": lambda entry: np.zeros((2, 3, 4)),
}


@pytest.mark.slow
@pytest.mark.parametrize("forge", FORGED.values(), ids=FORGED.keys())
@pytest.mark.parametrize("name", ["rows", "loop.theta"])
def test_a_forged_state_of_a_training(checkpointed, name, forge):
    arguments, entries = checkpointed
    forged = {**entries, f"state.{name}": forge(entries[f"state.{name}"])}
    arrays = {key: array for key, array in forged.items() if array is not None}
    np.savez(arguments["out"] / "checkpoint.npz", **arrays)
    assert not accepted(lambda: train("q-learning", PAPER, resume=True, **arguments))


@pytest.fixture(scope="module")
def text():
    with FmuPlant(PAPER) as plant:
        return simulate(plant, naive(PAPER), 4, 4).to_csv()


EDITS = {
    "empty": lambda text: "",
    "two columns of one name": lambda text: text.replace("P2 [kPa]", "X2 [kPa]"),
    "a number that is too large": lambda text: text.replace("25.0", "1e400"),
    "a word": lambda text: text.replace("25.0", "x"),
}


@pytest.mark.parametrize("edit", EDITS)
def test_a_trajectory_of_others_that_is_none(tmp_path, text, edit):
    (tmp_path / "run-4.csv").write_text(EDITS[edit](text))
    assert not accepted(lambda: judge(PAPER, tmp_path))
