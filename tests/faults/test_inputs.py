"""Bad values for every field of every schema and for every option of every command.

The fields come from the pydantic models and the options from Typer, so a new one is tested at once.
"""

import copy
import math
import types
import typing
from itertools import cycle

import numpy as np
import pytest
import typer
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

from controllers.errors import ParameterError
from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate
from cosim.cli.main import app
from cosim.core.errors import ScenarioError
from learning.algorithm import algorithms, load_algorithm
from learning.errors import ConfigurationError

# What `paper` leaves open is stated, so that every field has a place.
STATED = {
    "exploration": {"kind": "additive", "probability": 0.1, "standard_deviation": [3.0, 3.0]},
    "controller": {"value_offset": "discounted"},
}
PAPER = Scenario.load("paper").replace(STATED).to_dict()
OPTIONS = settings(
    max_examples=100,
    deadline=None,
    database=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)

numbers = st.one_of(st.integers(-(2**70), 2**70), st.floats(), st.booleans())
values = st.recursive(
    st.one_of(numbers, st.text(max_size=8), st.none()),
    lambda inner: st.one_of(
        st.lists(inner, max_size=5), st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)


def table_of(annotation):
    """The pydantic model in an annotation, if there is one."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        return next(filter(None, map(table_of, typing.get_args(annotation))), None)
    return None


def fields(model, prefix=()):
    """Path of every field, tables included, as in the TOML document."""
    for name, info in model.model_fields.items():
        path = (*prefix, info.alias or name)
        yield path
        if inner := table_of(info.annotation):
            yield from fields(inner, path)


FIELDS = sorted(set(fields(Scenario)))


def changed(path, value):
    document = copy.deepcopy(PAPER)
    table = document
    for name in path[:-1]:
        table = table.setdefault(name, {})
    table[path[-1]] = value
    return document


def at(document, path):
    for name in path:
        document = document[name]
    return document


def same(given_value, kept):
    """Whether a value was kept as given; whole numbers may stand for floats, lists for tuples."""
    if isinstance(given_value, list):
        return len(given_value) == len(kept) and all(map(same, given_value, kept))
    if isinstance(given_value, dict):
        return all(same(item, kept[key]) for key, item in given_value.items())
    return given_value == kept and isinstance(given_value, bool) == isinstance(kept, bool)


def one_line(error, origin):
    message = str(error)
    assert message.startswith(origin), message
    assert "\n" not in message
    assert "Traceback" not in message


@OPTIONS
@given(st.sampled_from(FIELDS), values)
def test_any_value_of_any_field_is_kept_or_refused_by_name(path, value):
    try:
        scenario = Scenario.from_dict(changed(path, value), "the file")
    except ScenarioError as error:
        one_line(error, "the file: ")
    else:
        if value is not None:
            assert same(value, at(scenario.to_dict(), path))


# Of the rules that have the same, the last one's name.
CONFIGURATIONS = {load_algorithm(name).Configuration: name for name in algorithms()}


@pytest.mark.parametrize("configuration", CONFIGURATIONS, ids=CONFIGURATIONS.get)
def test_any_value_of_any_hyperparameter_is_kept_or_refused(configuration):
    @settings(OPTIONS, max_examples=30)
    @given(st.sampled_from(sorted(configuration.model_fields)), values)
    def attack(field, value):
        try:
            kept = getattr(configuration.from_dict({field: value}), field)
        except ConfigurationError as error:
            one_line(error, "hyperparameters: ")
            assert field in str(error)
        else:
            assert kept is not None or value is None

    attack()


# The command line ------------------------------------------------------------------------------

# Each option meets one of the first, and one of the second, which are no numbers to the parser.
BAD = {int: cycle(["nan", "-1", "1" * 30]), float: cycle(["nan", "inf", "-1"])}
UNREADABLE = {int: cycle(["x", "1.5", "", "1e3"]), float: cycle(["x", "", "1,5"])}


def commands(command=None, words=()):
    """Every command of the application with the words that call it."""
    command = command or typer.main.get_command(app)
    inner = getattr(command, "commands", None)
    if inner is None:
        yield words, command
        return
    for name, each in inner.items():
        yield from commands(each, (*words, name))


def numeric_options():
    """Words of a command with a bad value for one numeric option, of each kind in turn."""
    for words, command in commands():
        needed = ["a" for p in command.params if p.required and p.param_type_name == "argument"] + [
            word
            for p in command.params
            if p.required and p.param_type_name == "option"
            for word in (p.opts[0], "q-learning")
        ]
        for parameter in command.params:
            kind = parameter.type_descriptor.annotation
            if kind not in BAD or parameter.param_type_name != "option":
                continue
            for bad in (next(UNREADABLE[kind]), next(BAD[kind])):
                is_seed = bad.isdigit() and parameter.opts[0] in (
                    "--seed",
                    "--first-seed",
                    "--seed-values",
                )
                # These are numbers to a parser; what they mean is tested with a file.
                numbers = ("--relative", "--at", "--divergence")
                odd = bad in ("nan", "inf") and parameter.opts[0] in numbers
                if is_seed or odd or (bad == "-1" and parameter.min is None):
                    continue
                yield [*words, *needed, parameter.opts[0], bad]


@pytest.mark.slow
def test_a_bad_number_is_refused_by_every_option(cosim, tmp_path):
    for words in numeric_options():
        code, out, err = cosim(*words)
        assert code == 2, words
        assert words[-2] in err, words
        assert "Traceback" not in err
        assert not out
    assert list(tmp_path.iterdir()) == []


WRONG = [
    "simulate --scenario papr",
    "simulate --controller nave",
    "simulate --controller json:make",
    "simulate --controller no-theta.toml",
    "simulate --controller type.toml",
    "simulate --out blocked/inside --steps 3",
    "evaluate --scheduler nonsense --steps 3 --seeds 1",
    "evaluate --first-seed 18446744073709551610 --seeds 10 --steps 3",
    "train --algorithm nothing",
    "train --algorithm q-learning --set step_size=zero",
    "train --algorithm q-learning --evaluate-every 70 --log-every 60",
    "fmu info none.fmu",
    "fmu info blocked",
    "view blocked --json",
    "new study class",
    "compare blocked blocked",
    "simulate --scenario folder.toml",
    "train --algorithm fixed --start folder.toml",
    "study run folder.toml",
    "scenario init evaporator --out folder.toml",
    "export tuned --local --out folder.toml",
    "results check --results nowhere",
]


@pytest.mark.parametrize("line", WRONG)
def test_a_wrong_name_is_one_line_and_exit_code_2(cosim, tmp_path, line):
    (tmp_path / "blocked").write_text("this is no folder, and no file of any known kind\n")
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / "type.toml").write_text('extends = "paper"\ndiscount = "high"\n')
    code, out, err = cosim(*line.split())
    assert code == 2, err
    assert "Traceback" not in err
    last = [text for text in err.splitlines() if text.strip()]
    assert last[-1].startswith("error: ")
    assert not out.strip()
    assert not list((tmp_path / "folder.toml").iterdir())


@pytest.mark.parametrize(
    "line",
    [
        "evaluate --seeds 1 --steps 3 --jobs 1",
        "train --algorithm q-learning --samples 20 --log-every 20 --evaluate-every 20",
    ],
)
def test_a_command_that_needs_the_model_left_out_says_so(cosim, tmp_path, line):
    document = copy.deepcopy(PAPER)
    del document["controller"]["model"]
    (tmp_path / "plain.toml").write_text(Scenario.from_dict(document).to_toml())
    code, out, err = cosim(*line.split(), "--scenario", "plain.toml")
    assert code == 2, err
    assert "model" in err
    assert not out.strip()


STEPS = 60


def everywhere(p, value):
    """A number for all of θ but the bounds, which would be refused for themselves."""
    changed = p.with_theta(np.full_like(p.theta, value))
    return changed.replace({name: p[name] for name in ("x_l", "x_u")}).theta


ABSURD = {
    "all zero": lambda p: everywhere(p, 0.0),
    "all huge": lambda p: everywhere(p, 1e12),
    "crossed bounds": lambda p: p.replace({"x_l": p["x_u"], "x_u": p["x_l"]}).theta,
}


@pytest.mark.parametrize("kind", ABSURD)
def test_an_absurd_theta_is_refused_or_the_loop_goes_on(paper, kind):
    controller = naive(paper)
    try:
        controller.theta = ABSURD[kind](controller.parameters)
    except ParameterError as error:
        assert "must stay below" in str(error)
        assert kind == "crossed bounds"
        return
    with FmuPlant(paper) as plant:
        run = simulate(plant, controller, STEPS, 0)
    assert (run.actions >= paper.action_lower).all()
    assert (run.actions <= paper.action_upper).all()
    assert run.summary()["failures"] == int(run["failed"].sum())
    assert math.isfinite(run.summary()["J"])
