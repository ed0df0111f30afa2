import json

import pytest
from typer.testing import CliRunner

from cosim.cli import app


@pytest.fixture(scope="module")
def result():
    command = ["benchmark", "controllers", "--steps", "50", "--every", "10", "--json"]
    answer = CliRunner().invoke(app, command)
    assert answer.exit_code == 0, answer.output
    return json.loads(answer.stdout)


def rows(result, solver):
    return {row["phase"]: row for row in result["rows"] if row["solver"] == solver}


@pytest.mark.parametrize("backend", ["daqp", "proxqp"])
def test_every_phase_of_a_sample_is_timed(result, backend):
    timed = rows(result, backend)
    whole = timed["prepare + feedback + dV/dθ"]
    assert 0 < timed["feedback"]["median_us"] < timed["V and dV/dθ"]["median_us"]
    assert whole["minimum_us"] >= timed["prepare"]["minimum_us"]
    assert whole["met"] == (whole["median_us"] <= whole["target_us"])
    assert {"prepare", "dπ/dθ", "Q and dQ/dθ"} < set(timed)


def test_the_alternatives_solve_the_same_samples_and_are_slower(result):
    assert result["compared"] == 5
    for solver in ("qpsolvers, proxqp, cold", "IPOPT, warm started"):
        row = rows(result, solver)["solve"]
        assert row["solved_share"] == 1.0
        assert row["ratio"] > 5
