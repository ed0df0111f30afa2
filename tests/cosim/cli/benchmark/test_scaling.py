import json

from typer.testing import CliRunner

from cosim.cli import app


def test_every_horizon_and_theta_is_timed_interpreted_and_as_it_runs(monkeypatch):
    monkeypatch.setenv("COSIM_COMPILE", "never")
    answer = CliRunner().invoke(app, ["benchmark", "scaling", "--horizons", "2,3", "--json"])
    assert answer.exit_code == 0, answer.output
    rows = json.loads(answer.stdout)["rows"]
    assert [(row["horizon"], row["theta"], row["n_theta"]) for row in rows] == [
        (2, "paper", 31),
        (3, "paper", 31),
        (10, "slack weights", 35),
        (10, "model parameters", 33),
    ]
    for row in rows:
        (phases,) = row["microseconds"].values()
        assert set(phases) == set(row["ratios"]) == {"prepare", "feedback", "dV/dθ", "dπ/dθ"}
        assert all(value > 0 for value in phases.values())


def test_a_bad_list_of_horizons_is_refused():
    for text in ("10,x", "0", "2000"):
        answer = CliRunner().invoke(app, ["benchmark", "scaling", "--horizons", text])
        assert "--horizons must be numbers from 1 to 1000" in str(answer.exception)
    answer = CliRunner().invoke(app, ["benchmark", "scaling", "--horizons", ""])
    assert "'--horizons' is empty" in str(answer.exception)
