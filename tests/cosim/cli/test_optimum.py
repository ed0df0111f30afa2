"""`cosim optimum`: J*, bounds, files and errors."""

import json

import pytest

from controllers.dynamic_programming import archive


def test_stored_optimum_as_json(cosim):
    code, out, _ = cosim("optimum", "--scenario", "paper", "--json")
    document = json.loads(out)
    assert code == 0
    assert document["J"] == pytest.approx(6337.87, abs=0.01)
    assert document["lower"] <= document["J"] <= document["upper"]
    assert document["upper"] - document["lower"] < 1e-3 * document["J"]
    assert document["stable"] is True
    assert document["file"].endswith(".npz")


def test_table_shows_value_and_bounds(cosim):
    code, out, _ = cosim("optimum", "--scenario", "fast-sampling")
    assert code == 0
    assert "J* above" in out
    assert "6224.99" in out


def test_unknown_scenario_is_one_line_of_error(cosim):
    code, out, err = cosim("optimum", "--scenario", "papper")
    assert (code, out) == (2, "")
    assert err.startswith("error: unknown scenario 'papper'")
    assert err.count("\n") == 1


def test_unknown_criterion_is_refused(cosim):
    code, _, err = cosim("optimum", "--criterion", "total")
    assert code == 2
    assert "'average', 'discounted'" in err


def test_damaged_cache_is_named_with_the_cure(cosim, tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "cache_folder", lambda: tmp_path)
    for shipped in archive.SHIPPED.glob("*.npz"):
        (tmp_path / shipped.name).write_bytes(b"damaged")
    code, out, err = cosim("optimum", "--scenario", "paper")
    assert (code, out) == (2, "")
    assert "not a readable optimal policy" in err
    assert "delete it to have the policy computed anew" in err


def test_a_cache_that_cannot_be_written_is_refused_before_the_work(cosim, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "file"))
    code, out, err = cosim("optimum", "--scenario", "paper", "--recompute")
    assert (code, out) == (2, "")
    assert "error: " in err
    assert "COSIM_CACHE" in err


@pytest.mark.slow
def test_solving_anew_ends_in_the_optimum_that_is_shipped(cosim, tmp_path, monkeypatch):
    monkeypatch.setattr(archive, "cache_folder", lambda: tmp_path)
    code, out, _ = cosim("optimum", "--scenario", "paper", "--recompute", "--json")
    assert code == 0
    assert json.loads(out)["J"] == pytest.approx(6337.868736630078, rel=1e-6)
    assert len(list(tmp_path.glob("**/*.npz"))) == 1
