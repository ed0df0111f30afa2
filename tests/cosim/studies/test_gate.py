"""A change of one per cent in what the gate guards trips it."""

import dataclasses
import json
import shutil
from functools import cached_property
from pathlib import Path

import pytest
from typer.testing import CliRunner

from controllers import evaporator
from controllers.problem import Problem
from controllers.rti.nmpc import RtiSolution
from cosim.cli.main import app
from cosim.plant.wiring import Wiring
from learning.back_off import BackOffSearch

pytestmark = pytest.mark.campaign
STORED = Path(__file__).parents[3] / "results"


def plant(patch):
    """The plant's heat transfer."""
    start_value = Wiring._start_value

    def changed(self, name, value, table):
        factor = 1.01 if (name, table) == ("UA2", "plant.parameters") else 1.0
        return start_value(self, name, factor * value, table)

    patch.setattr(Wiring, "_start_value", changed)


def model(patch):
    """The heat transfer in the controller's model; the plants of the gate have their own."""
    changed = [
        dataclasses.replace(q, nominal=1.01 * q.nominal) if q.name == "UA2" else q
        for q in evaporator.PARAMETER_VALUES
    ]
    patch.setattr(evaporator, "PARAMETERS", tuple(changed))


def discount(patch):
    """The discount of the controller's problem."""
    build = Problem.from_scenario.__func__
    changed = lambda cls, s: dataclasses.replace(build(cls, s), discount=s.discount / 1.01)  # noqa: E731
    patch.setattr(Problem, "from_scenario", classmethod(changed))


def gradient(patch):
    """The sign of dV/dθ and dQ/dθ."""
    value_gradient = RtiSolution.value_gradient.func
    changed = cached_property(lambda self: -value_gradient(self))
    changed.__set_name__(RtiSolution, "value_gradient")
    patch.setattr(RtiSolution, "value_gradient", changed)


def back_off(patch):
    """The rule that moves the bounds."""
    exact = BackOffSearch.backed_off
    patch.setattr(BackOffSearch, "backed_off", lambda self, kappa: exact(self, 1.01 * kappa))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    for name in ("gate.toml", "tolerances.toml"):
        shutil.copy(STORED / name, folder)
    shutil.copytree(STORED / "gate", folder / "gate")
    return folder


def check(folder):
    words = ["results", "check", "gate", "--results", str(folder), "--jobs", "1", "--json"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code in (0, 1), result.output + repr(result.exception)
    return json.loads(result.stdout)["differences"]["gate"]


def test_without_a_change_the_gate_holds(folder):
    assert check(folder) == []


@pytest.mark.parametrize("mutation", [plant, model, discount, gradient, back_off])
def test_a_change_of_one_per_cent_trips_it(folder, monkeypatch, mutation):
    mutation(monkeypatch)
    assert check(folder) != []
