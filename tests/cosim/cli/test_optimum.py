"""`cosim optimum`: J*, bounds, files and errors."""

import json
from dataclasses import replace

import pytest

from controllers import optimum as store
from controllers.dynamic_programming.bellman import PlantProblem
from controllers.dynamic_programming.policy_iteration import Certificate, Figure, Settings
from cosim import Scenario


def test_stored_optimum_as_json(cosim):
    code, out, _ = cosim("optimum", "--scenario", "paper", "--json")
    document = json.loads(out)
    assert code == 0
    assert document["J"] == pytest.approx(6337.8, abs=0.1)
    assert (document["kind"], document["objection"]) == ("optimum", None)
    names = [figure["name"] for figure in document["certificate"]]
    assert names[:3] == ["solution", "refinement", "simulation"]
    assert document["lower"] <= document["J"] <= document["upper"]
    assert document["upper"] - document["lower"] < 1e-3 * document["J"]
    assert document["stable"] is True
    assert document["file"].endswith(".npz")


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))


def test_without_a_certificate_it_is_a_reference(cosim, tmp_path, monkeypatch):
    plant = PlantProblem.from_scenario(Scenario.load("paper"))
    key = store.optimum_key(plant, Settings())
    known = store.read_optimum(store.SHIPPED / f"{key}.npz", key)
    monkeypatch.setattr(store, "SHIPPED", tmp_path / "none")
    store.keep(key, replace(known, certificate=None))
    code, out, err = cosim("optimum", "--scenario", "paper")
    assert code == 0
    assert "reference of paper" in out
    assert "not called J*: no certificate; make one with --refine" in out + err
    figures = known.certificate.figures
    apart = (Figure("solution", 6300.0, 6300.0, 6300.0), *figures[1:])
    apart = replace(known, certificate=Certificate(apart))
    store.keep(key, apart)
    code, out, _ = cosim("optimum", "--scenario", "paper", "--json")
    document = json.loads(out)
    assert document["kind"] == "reference"
    assert "apart, more than 0.05 %" in document["objection"]


def test_a_drifting_plant_has_the_quasi_static_reference(cosim):
    code, out, _ = cosim("optimum", "--scenario", "drifting", "--json")
    document = json.loads(out)
    assert code == 0
    assert document["kind"] == "reference"
    gains = [row["J"] for row in document["table"]]
    assert gains == sorted(gains, reverse=True)
    assert gains[-1] < document["J"] < gains[0]


def test_damaged_cache_is_named_with_the_cure(cosim, tmp_path, monkeypatch):
    folder = tmp_path / "optima"
    folder.mkdir(mode=0o700)
    for shipped in store.SHIPPED.glob("*.npz"):
        (folder / shipped.name).write_bytes(b"damaged")
    monkeypatch.setattr(store, "SHIPPED", tmp_path / "none")
    code, out, err = cosim("optimum", "--scenario", "paper")
    assert (code, out) == (2, "")
    assert "not a readable optimal policy" in err
    assert "delete it to have the policy computed anew" in err


@pytest.mark.slow
def test_solving_anew_ends_in_the_optimum_that_is_shipped(cosim, tmp_path, monkeypatch):
    code, out, _ = cosim("optimum", "--scenario", "paper", "--recompute", "--json")
    assert code == 0
    assert json.loads(out)["J"] == pytest.approx(6337.8, rel=3e-5)
    assert len(list(tmp_path.glob("**/*.npz"))) == 1
