"""`cosim optimum`: J*, bounds, files and errors; `cosim tuning`: certificate and θ file."""

import json

import pytest

from controllers import optimum as store


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
    assert document["file"].endswith(".npz")


@pytest.fixture(autouse=True)
def own_cache(monkeypatch, tmp_path):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))


def test_damaged_cache_is_named_with_the_cure(cosim, tmp_path, monkeypatch):
    folder = tmp_path / "optima"
    folder.mkdir(mode=0o700)
    for shipped in store.SHIPPED_OPTIMA.glob("*.npz"):
        (folder / shipped.name).write_bytes(b"damaged")
    monkeypatch.setattr(store, "SHIPPED_OPTIMA", tmp_path / "none")
    code, out, err = cosim("optimum", "--scenario", "paper")
    assert (code, out) == (2, "")
    assert "not a readable optimal policy" in err
    assert "delete it to have the policy computed again" in err


@pytest.mark.parametrize(
    ("scenario", "J"),
    [
        # Without a disturbance it is the cost of the best steady state.
        pytest.param("nominal", 6210.384509575885, marks=pytest.mark.slow),
        pytest.param("paper", 6337.8, marks=pytest.mark.campaign),
    ],
)
def test_solving_anew_ends_in_the_known_optimum(cosim, tmp_path, scenario, J):
    code, out, _ = cosim("optimum", "--scenario", scenario, "--recompute", "--json")
    assert code == 0
    assert json.loads(out)["J"] == pytest.approx(J, rel=3e-5)
    assert len(list(tmp_path.glob("**/*.npz"))) == 1


def test_the_tunings_certificate_as_json(cosim):
    code, out, _ = cosim("tuning", "--scenario", "paper", "--json")
    document = json.loads(out)
    assert code == 0
    assert abs(document["active"]["X2 ≥ 25 %"] - 60.29) < 0.01
    assert document["economic_eigenvalues"][0] < 0 < document["convexified_eigenvalues"][0]
    assert document["gain_error"] < 1e-8


def test_the_tuning_reads_aloud(cosim):
    code, out, _ = cosim("tuning", "--scenario", "paper")
    words = " ".join(out.replace("│", " ").split())
    assert code == 0
    assert "X2 ≥ 25 % costs 60.3 a per cent" in words
    assert "none: the economic cost is tuned as it is" in words
    assert "eigenvalues" not in words
