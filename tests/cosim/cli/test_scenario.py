"""`cosim scenario init`: what it drafts runs, and what it cannot guess it says."""

import json
import math
import re

import numpy as np
import pytest

import fmus
from cosim import FmuPlant, Scenario
from tests.helpers.kinds import REALS, build_kind
from tests.helpers.tank import build_tank, edited


def drift(scenario):
    """How far a sample moves the undisturbed plant from its reference, as a share of it."""
    quiet = scenario.replace({"disturbance": {"law": "none"}})
    with FmuPlant(quiet) as plant:
        s = plant.reset(0, scenario.reference_state)
        step = plant.step(scenario.reference_action)
    assert step.stage_cost == pytest.approx(scenario.controller.reference_cost, rel=1e-9)
    return np.max(np.abs(step.s - s) / np.maximum(np.abs(s), 1e-2))


@pytest.mark.slow
def test_the_evaporators_draft_is_the_paper_but_for_what_nobody_could_know(cosim, tmp_path, paper):
    code, out, err = cosim("scenario", "init", "evaporator")
    assert code == 0
    assert "CHECK" in out and "evaporator.toml" in err
    drafted = Scenario.load(tmp_path / "evaporator.toml")
    known = paper.to_dict()
    found = drafted.to_dict()
    for table in ("disturbance", "penalty"):
        assert found[table] == known[table]
    for field in ("states", "actions", "disturbances", "stage_cost", "mapping"):
        assert found["plant"][field] == known["plant"][field], field
    assert (found["sampling_time"], found["bounds"]["action_upper"]) == (60.0, [400.0, 400.0])
    # The FMU's start values are the operating point with seven digits.
    assert drafted.reference_state == pytest.approx(paper.reference_state, rel=1e-6)
    assert drafted.reference_action == pytest.approx(paper.reference_action, rel=1e-6)
    assert drift(drafted) < 1e-9
    # The FMU's bounds of the states are far apart: the model needs more steps at their corners.
    assert drafted.controller.substeps == 4
    code, out, _ = cosim("simulate", "-s", "evaporator.toml", "-n", 20, "--json")
    assert code == 0 and json.loads(out)["failures"] == 0


@pytest.mark.parametrize("name", ["reactor", "tanks", "dead-time"])
def test_a_plants_draft_has_the_roles_that_its_scenario_has(cosim, tmp_path, name):
    known = Scenario.load(name)
    code, out, _ = cosim("scenario", "init", known.plant.fmu, "--out", "draft.toml", "--json")
    assert code == 0
    assert json.loads(out)["plant"]["states"]
    assert "a memory" in (tmp_path / "draft.toml").read_text()
    drafted = Scenario.load(tmp_path / "draft.toml")
    for field in ("states", "actions", "disturbances", "stage_cost", "mapping"):
        assert getattr(drafted.plant, field) == getattr(known.plant, field), field
    assert drafted.sampling_time == known.sampling_time
    assert drafted.controller.model == known.controller.model
    assert drift(drafted) < 1e-9


@pytest.fixture(scope="module")
def tank(tmp_path_factory):
    return build_tank(tmp_path_factory.mktemp("tank"), saves=False)


def test_a_foreign_fmu_needs_no_more_than_names_and_a_time(cosim, tank, tmp_path):
    code, _, err = cosim("scenario", "init", tank)
    assert code == 2 and "--sampling-time" in err
    code, _, _ = cosim("scenario", "init", tank, "--sampling-time", 0.5, "--out", "tank.toml")
    assert code == 0
    drafted = Scenario.load(tmp_path / "tank.toml")
    assert drafted.plant.states == ("x",)
    assert drafted.plant.mapping.initial_state == ("x_start",)
    assert drift(drafted) < 1e-9
    text = (tmp_path / "tank.toml").read_text()
    assert "CHECK: the FMU states no bound of x" in text
    # The sensors that it proposes are comments, and valid once they are none.
    lines = text.splitlines()
    proposed = [line.removeprefix("# ") for line in lines[lines.index("# [[sensor]]") :]]
    (tmp_path / "measured.toml").write_text("\n".join(['extends = "tank.toml"', *proposed]))
    assert drafted.sensors is None
    assert Scenario.load(tmp_path / "measured.toml").sensors[0].variable == "x"
    code, _, err = cosim("scenario", "init", tank, "--sampling-time", 0.5, "--out", "tank.toml")
    assert code == 2 and "--overwrite" in err


def test_what_cannot_be_guessed_is_asked_for(cosim, tank, tmp_path):
    def changed(old, new):
        return edited(tank, tmp_path / "other.fmu", lambda text: text.replace(old, new))

    for old, new, words in (
        ('name="cost"', 'name="outflow"', "give --cost NAME, one of x, outflow"),
        ('name="x"', 'name="other_cost"', "other_cost and cost could be"),
        ('name="x_start"', 'name="level0"', "--states A,B"),
        ('"input"><Real start="0"', '"local"><Real', "has no input and no tunable parameter"),
        ('causality="output"', 'causality="local"', "no scalar real output"),
    ):
        code, _, err = cosim("scenario", "init", changed(old, new), "--sampling-time", 0.5)
        assert code == 2, err
        assert words in err
        assert "Traceback" not in err


def test_a_plant_that_starts_where_it_likes_has_its_reference_there(cosim, tank, tmp_path):
    other = edited(tank, tmp_path / "o.fmu", lambda text: text.replace('"x_start"', '"level0"'))
    words = ("--states", "x", "--sampling-time", 0.5, "--action", 2)
    code, out, err = cosim("scenario", "init", other, *words, "--json")
    assert code == 0, err
    drafted = json.loads(out)
    assert drafted["plant"]["mapping"]["initial_state"] == []
    assert drafted["controller"]["reference_action"] == [2.0]
    with FmuPlant(Scenario.load(tmp_path / "o.toml")) as plant:
        assert drafted["controller"]["reference_state"] == plant.reset(0).tolist()


@pytest.mark.parametrize(
    ("state", "parameter"),
    [
        ("c", "c_start"),
        ("reactor.c[1]", "reactor.c_start[1]"),
        ("A[1,2]", "A_start[1,2]"),
        ("tank.medium.T", "tank.T_start"),
        ("HeatCapacity1.p1.T", "HeatCapacity1.T0"),
        ("x", "xInit"),
        ("x", "initial_x"),
    ],
)
def test_a_start_parameter_is_found_by_the_names_that_tools_give_it(
    cosim, tmp_path, state, parameter
):
    words = (init(tmp_path, state, parameter), "--states", state, "--sampling-time", 0.5)
    code, out, err = cosim("scenario", "init", *words, "--json")
    assert code == 0, err
    assert json.loads(out)["plant"]["mapping"]["initial_state"] == [parameter]


def init(folder, state, parameter):
    """A kind whose state and start parameter have these names."""
    names = {'"x"': f'"{state}"', '"x_start"': f'"{parameter}"'}

    def renamed(text):
        for old, new in names.items():
            text = text.replace(old, new)
        return text

    return edited(build_kind(folder, 2), folder / "renamed.fmu", renamed)


def test_a_parameter_that_does_not_set_the_start_is_not_taken_for_one(cosim, tmp_path):
    """The range is called x_start here, and the state starts at 1 whatever it is."""
    fmu = build_kind(
        tmp_path, 2, reals=REALS.replace("x_start 3", "x_begin 3").replace("range", "x0")
    )
    words = ("--states", "x", "--sampling-time", 0.5, "--json")
    code, out, err = cosim("scenario", "init", fmu, *words)
    assert code == 0, err
    assert json.loads(out)["plant"]["mapping"]["initial_state"] == []


@pytest.mark.parametrize("none", ["1e60", "1.7976931348623157e308", "1e30", "INF"])
def test_a_number_that_stands_for_no_bound_is_none(cosim, tmp_path, none):
    bounds = f'<Real start="2" min="-{none}" max="{none}"/>'
    other = edited(
        build_kind(tmp_path, 2),
        tmp_path / "free.fmu",
        lambda text: text.replace('<Real start="0"/>', bounds, 1),
    )
    code, out, err = cosim("scenario", "init", other, "--sampling-time", 0.5)
    assert code == 0, err
    drafted = Scenario.load(tmp_path / "free.toml")
    assert (drafted.action_lower.tolist(), drafted.action_upper.tolist()) == ([0.0], [4.0])
    assert "does not bound u on both sides" in out


def test_a_draft_names_what_moves_nothing_and_what_nobody_drives(cosim, tmp_path):
    """The range multiplies the seed, which is 0: as an action it moves nothing."""
    reals = REALS.replace("range 4  parameter  fixed", "range 4  input -")
    fmu = build_kind(tmp_path, 2, reals=reals)
    words = (fmu, "--sampling-time", 0.5, "--actions", "range", "--overwrite")
    code, out, err = cosim("scenario", "init", *words)
    assert code == 0, err
    assert "CHECK: no state moves by range" in out
    assert "CHECK: nobody drives u = 0" in out


def test_a_draft_for_a_controller_needs_neither_a_law_nor_bounds(cosim, tmp_path):
    """As many tools write FMUs: ranges of the noise are parameters, its law is no choice."""

    def bare(text):
        for name in ("law", "law_number", "stochastic"):
            text = text.replace(f'name="{name}"', f'name="own_{name}"')
        for name in ("cA", "T"):
            limits = rf'(name="{name}"[^>]*>\s*<Real[^>]*?) min="[^"]*" max="[^"]*"'
            text = re.sub(limits, r"\1", text)
        return text

    fmu = edited(fmus.path("reactor"), tmp_path / "bare.fmu", bare)
    words = ("--model", "controllers.reactor:model", "--states", "cA,T", "--cost", "cost")
    code, out, err = cosim("scenario", "init", fmu, *words, "--json")
    assert code == 0, err
    drafted = json.loads(out)
    assert drafted["disturbance"]["law"] == "uniform"
    assert all(map(math.isfinite, drafted["bounds"]["state_lower"]))
    text = (tmp_path / "bare.toml").read_text()
    assert "CHECK: the FMU does not bound cA, T on both sides" in text
    assert "CHECK: the FMU has no choice of laws" in text
    code, out, err = cosim("simulate", "-s", "bare.toml", "-n", 5, "--json")
    assert code == 0, err
