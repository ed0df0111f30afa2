"""`cosim fmu check --model`: whether an FMU and a controller's model are the same plant."""

import json
from dataclasses import replace

import casadi as ca
import pytest

from controllers import Model, Quantity, evaporator
from controllers.errors import ModelError
from cosim.core.errors import PlantError
from cosim.model_check import check_model
from tests.helpers.compiler import needs_compiler
from tests.helpers.tank import build_tank


def test_the_evaporators_model_is_its_fmu(cosim):
    code, out, err = cosim(
        "fmu", "check", "evaporator", "--model", "controllers.evaporator:model", "--points", 20
    )
    lines = out.splitlines()
    assert (code, err) == (0, "")
    assert [line.partition(":")[0] for line in lines[:-1]] == [
        "X2 a sample later",
        "P2 a sample later",
        "economic_cost",
    ]
    assert lines[-1] == "FMU and model agree at 20 points"


def test_the_same_seed_gives_the_same_bytes(cosim):
    command = ("fmu", "check", "tanks", "--model", "controllers.tanks:model", "--scenario", "tanks")
    first = cosim(*command, "--points", 10, "--json")
    assert first == cosim(*command, "--points", 10, "--json")
    assert json.loads(first[1])["agrees"]
    assert first != cosim(*command, "--points", 10, "--seed", 1, "--json")


def test_a_fault_of_one_rate_is_found_and_has_its_size():
    """P2's rate with 1 kPa a minute too much: 1 kPa in a sample of a minute, at every point."""
    model = evaporator.model()

    def wrong(x, u, d, p):
        return model.ode(x, u, d, p) + ca.vertcat(0, 1 / 60 * model.time_unit)

    outcome = check_model("evaporator", replace(model, ode=wrong), scenario="paper", points=20)
    by_name = {item.name: item for item in outcome.differences}
    assert not outcome.agrees
    assert outcome.verdict.startswith("FMU and model differ in ")
    assert "P2 a sample later" in outcome.verdict
    found = by_name["P2 a sample later"]
    assert found.model - found.fmu == pytest.approx(1.0, rel=0.1)
    assert set(found.where) > {"X2", "P2", "P100", "F200", "F1"}
    assert by_name["economic_cost"].difference < 1e-9
    assert " 1 (" not in str(by_name["economic_cost"])


def test_a_fault_of_the_cost_is_found():
    model = evaporator.model()
    dearer = replace(model, economic_cost=lambda *point: 1.5 * model.economic_cost(*point))
    outcome = check_model("evaporator", dearer, scenario="paper", points=20)
    assert outcome.verdict == "FMU and model differ in economic_cost"


def test_another_parameter_of_the_plant_is_a_remark():
    outcome = check_model("evaporator", evaporator.model(), scenario="fouled", points=5)
    assert any(remark.startswith("parameter UA2 is 5.2") for remark in outcome.remarks)
    assert not outcome.agrees


def tank_model(time_constant=2.0):
    return Model(
        name="tank",
        states=(Quantity("level", "m"),),
        actions=(Quantity("inflow", "m"),),
        disturbances=(),
        parameters=(),
        ode=lambda x, u, d, p: (u - x) / time_constant,
        economic_cost=lambda x, u, d, p: u[0] ** 2,
    )


@needs_compiler
def test_a_foreign_fmu_takes_the_names_that_are_given(tmp_path):
    fmu = build_tank(tmp_path, saves=False)
    names = {"states": ["x"], "actions": ["u"], "stage_cost": "cost", "sampling_time": 0.5}
    right = check_model(fmu, tank_model(), points=20, **names)
    assert right.agrees
    wrong = check_model(fmu, tank_model(2.5), points=20, **names)
    assert wrong.verdict == "FMU and model differ in x a sample later"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--model", "controllers.tanks:nothing"), "has no attribute 'nothing'"),
        (("--model", "controllers.tanks:model"), "give the FMU's names by --states A,B,…"),
        (("--model", "controllers.evaporator:model", "--states", "X2"), "has 2 states (X2, P2)"),
        (("--model", "controllers.evaporator:model", "--states", "X2,P3"), "no variable 'P3'"),
        (
            ("--model", "controllers.evaporator:model", "--scenario", "paper", "--cost", "x"),
            "give a scenario, or names and a sampling time, not both",
        ),
        (("--points", "3"), "go with --model"),
    ],
)
def test_bad_input_is_one_line(cosim, arguments, words):
    code, out, err = cosim("fmu", "check", "evaporator", *arguments)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert words in err


def test_a_model_that_is_not_finite_somewhere_is_refused():
    model = replace(tank_model(), economic_cost=lambda x, u, d, p: ca.sqrt(-1 - x[0] ** 2))
    with pytest.raises((ModelError, PlantError), match="no finite number"):
        check_model("heater", model, states=["T"], actions=["Q"], stage_cost="cost", points=3)
