"""The reactor and the tanks: built, in agreement with the controller's model, run."""

import json
import re
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from benchmarks import importers
from controllers.factories import naive
from controllers.problem import load_model
from cosim import FmuPlant, Scenario, simulate
from cosim.core.files import CACHE_VARIABLE
from fmus import plant as plants
from fmus.plant import build_plant
from tests.helpers.command import run_cosim
from tests.helpers.tank import edited

PRESETS = {"heater": "dead-time", "unstable_reactor": "unstable-reactor"}
"""Presets that are called otherwise than their plant."""
PAGE = Path(__file__).parents[2] / "docs" / "reference" / "scenario.md"


class Plant:
    """A preset with its model, and its FMU built here for FMI 2.0 and 3.0."""

    def __init__(self, name, folder):
        self.name, self.folder = name, folder
        self.fmu = self.build(folder / f"{name}.fmu", 2)
        self.fmu3 = self.build(folder / f"{name}3.fmu", 3)
        self.scenario = Scenario.load(PRESETS.get(name, name))
        self.model = load_model(self.scenario.controller.model)

    def build(self, target, version):
        return build_plant(plants.model(self.name), plants.equations(self.name), target, version)


@pytest.fixture(scope="module", params=plants.SHIPPED_PLANTS)
def example(request, tmp_path_factory):
    return Plant(request.param, tmp_path_factory.mktemp(request.param))


def result_of(folder, *words):
    result = run_cosim(*words, "--json", folder=folder)
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3])
def test_every_installed_importer_passes(example, version):
    findings = importers.check(example.fmu if version == 2 else example.fmu3)
    allowed = (importers.PASSED, importers.NOT_INSTALLED, importers.NOT_OFFERED)
    assert [f for f in findings if f.status not in allowed] == []
    assert sum(f.status == importers.PASSED for f in findings) >= 4


def test_both_fmi_versions_give_the_same_bits(example):
    rows = []
    for fmu in (example.fmu, example.fmu3):
        with FmuPlant(example.scenario, fmu) as plant:
            rows.append(simulate(plant, naive(example.scenario), 100, seed=2**40 + 1))
    np.testing.assert_array_equal(rows[0].states, rows[1].states)
    np.testing.assert_array_equal(rows[0].disturbances, rows[1].disturbances)
    np.testing.assert_array_equal(rows[0]["stage_cost"], rows[1]["stage_cost"])


def test_plant_and_model_agree_where_their_parameters_do(example):
    """CVODES on the controller's model against the FMU's steps, under random actions."""
    if example.name == "heater":
        pytest.skip("its model does not have the pipe")
    scenario = example.scenario
    model = example.model
    n, m, k = len(model.states), len(model.actions), len(model.disturbances)
    x, u, d = ca.MX.sym("x", n), ca.MX.sym("u", m), ca.MX.sym("d", k)
    p = ca.DM([quantity.nominal for quantity in model.parameters])
    dae = {"x": x, "p": ca.vertcat(u, d), "ode": model.ode(x, u, d, p)}
    span = scenario.sampling_time / model.time_unit
    flow = ca.integrator("flow", "cvodes", dae, 0.0, span, {"reltol": 1e-10, "abstol": 1e-12})
    cost = ca.Function("cost", [x, u, d], [model.economic_cost(x, u, d, p)])
    lower, upper = scenario.action_lower, scenario.action_upper
    rng = np.random.default_rng(0)
    nominal = {q.name: q.nominal for q in model.parameters}
    true = {name: nominal[name] for name in scenario.plant.parameters}
    with FmuPlant(scenario.replace({"plant": {"parameters": true}})) as plant:
        state = plant.reset(1)
        for _ in range(20):
            action = scenario.reference_action + 0.1 * (upper - lower) * rng.uniform(-1, 1, m)
            step = plant.step(action)
            after = flow(x0=state, p=np.concatenate([action, step.disturbance]))["xf"]
            np.testing.assert_allclose(step.s, np.array(after).ravel(), rtol=1e-6)
            expected = float(cost(state, action, step.disturbance))
            assert step.stage_cost == pytest.approx(expected, rel=1e-10)
            state = step.s


def test_the_heater_is_its_model_and_eight_lags():
    scenario = Scenario.load("dead-time")
    model = load_model(scenario.controller.model)
    x, u, d = ca.MX.sym("x", 10), ca.MX.sym("u", 2), ca.MX.sym("d", 2)
    p = ca.DM([quantity.nominal for quantity in model.parameters])
    lags = (x[1:-1] - x[2:]) / (5.0 / 8)
    ode = ca.vertcat(model.ode(x[:2], u, d, p), lags)
    dae = {"x": x, "p": ca.vertcat(u, d), "ode": ode}
    flow = ca.integrator("flow", "cvodes", dae, 0.0, 1.0, {"reltol": 1e-10, "abstol": 1e-12})
    rng = np.random.default_rng(0)
    with FmuPlant(scenario) as plant:
        plant.reset(1)
        state = np.array([100.0, *[60.0] * 9])
        for _ in range(20):
            action = scenario.reference_action * rng.uniform(0.9, 1.1, 2)
            step = plant.step(action)
            state = flow(x0=state, p=np.concatenate([action, step.disturbance]))["xf"]
            np.testing.assert_allclose(step.s, np.array(state).ravel()[[0, -1]], rtol=1e-7)


def test_the_unstable_reactor_is_unstable():
    """Without control its linearisation at the reference grows by more than 1 a sample."""
    scenario = Scenario.load("unstable-reactor")
    model = load_model(scenario.controller.model)
    x, u, d, p = model.symbols()
    jacobian = ca.Function("J", [x, u, d, p], [ca.jacobian(model.ode(x, u, d, p), x)])
    A = jacobian(
        scenario.reference_state,
        scenario.reference_action,
        model.nominal_disturbance,
        model.nominal_parameters,
    )
    growth = np.exp(np.linalg.eigvals(np.array(A)) * scenario.sampling_time / model.time_unit)
    assert 1.9 < np.abs(growth).max() < 2.1


def test_draws_fill_their_ranges_and_repeat_with_the_seed(example):
    scenario = example.scenario
    with FmuPlant(scenario) as plant:
        first, again, other = (simulate(plant, naive(scenario), 300, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.disturbances, again.disturbances)
    assert not np.isin(first.disturbances, other.disturbances).any()
    law = scenario.disturbance
    offset = (first.disturbances - law.nominal) / law.ranges
    assert np.abs(offset).max() <= 1.0
    np.testing.assert_allclose(offset.std(axis=0), 1 / np.sqrt(3), rtol=0.1)


@pytest.mark.slow
def test_tuning_finds_the_stored_reference(example, tmp_path, monkeypatch):
    # At the heater's vertex nothing determines the cost's size, and the tuning warns of it.
    monkeypatch.setenv("PYTHONWARNINGS", "error,ignore::UserWarning")
    found = result_of(tmp_path, "tuning", "--scenario", example.scenario.name)
    steady = found["steady_state"]
    np.testing.assert_allclose(steady["states"], example.scenario.reference_state, rtol=1e-6)
    np.testing.assert_allclose(steady["actions"], example.scenario.reference_action, rtol=1e-6)


@pytest.mark.slow
def test_the_optimum_of_an_own_model_is_the_documented_one(example, tmp_path, monkeypatch):
    """The tanks and the unstable reactor have too many states, and the heater hides some."""
    if example.name != "reactor":
        pytest.skip("it has no documented optimum")
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    found = result_of(tmp_path, "optimum", "--scenario", example.name, "--recompute")
    stated = re.search(
        rf"`{example.name}`.*J\* = ([\d.]+) by `cosim optimum`", PAGE.read_text("utf-8")
    )
    assert stated is not None
    assert found["J"] == pytest.approx(float(stated[1]), rel=5e-4)


@pytest.mark.slow
def test_a_plant_that_cannot_save_its_state_leaves_no_checkpoint_and_says_so(example):
    saves = re.compile(r'\s(canGetAndSetFMUstate|canSerializeFMUstate)="\w+"')
    plain = edited(example.fmu, example.folder / "plain.fmu", lambda text: saves.sub("", text))
    plainly = example.scenario.replace({"plant": {"fmu": str(plain)}})
    (example.folder / "plain.toml").write_text(plainly.to_toml())
    words = ["train", "-s", "plain.toml", "-a", "q-learning"]
    words += ["--samples", "60", "--log-every", "60", "--evaluate-every", "60"]
    words += ["--checkpoint-every", "60", "--out", "short"]
    result = run_cosim(*words, folder=example.folder)
    assert "canGetAndSetFMUstate" in result.stderr
    assert "native code of" in result.stderr
    assert not (example.folder / "short" / "checkpoint.npz").exists()
