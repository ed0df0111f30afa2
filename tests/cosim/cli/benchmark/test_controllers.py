import json
import os
import sys
import types

import numpy as np
import pytest
from typer.testing import CliRunner

from controllers import ConvergedNmpc, Parameters, Problem
from controllers.functions import find_compiler
from cosim.cli import app
from cosim.cli.benchmark import references
from cosim.scenario import Scenario

COMMAND = ["benchmark", "controllers", "--steps", "50", "--every", "10", "--json"]
SAMPLE = "DAQP: prepare + feedback + dV/dθ"


def run():
    answer = CliRunner().invoke(app, COMMAND)
    assert answer.exit_code == 0, answer.output
    return json.loads(answer.stdout)


@pytest.fixture(scope="module")
def result():
    # Without the compiler, which takes seconds: see the slow test for what it adds.
    before = os.environ.get("COSIM_COMPILE")
    os.environ["COSIM_COMPILE"] = "never"
    yield run()
    os.environ.pop("COSIM_COMPILE") if before is None else os.environ.update(COSIM_COMPILE=before)


def rows(result):
    return {(row["name"], row["reference"]): row for row in result["rows"]}


def test_every_phase_of_a_sample_is_timed(result):
    timed = {row["name"]: row for row in result["rows"] if row["reference"] is None}
    names = {name for name in timed if name.startswith("DAQP")}
    assert {"DAQP: prepare", "DAQP: feedback", "DAQP: dπ/dθ", "DAQP: Q and dQ/dθ"} < names
    assert 0 < timed["DAQP: feedback"]["median_us"] < timed["DAQP: V and dV/dθ"]["median_us"]
    assert timed[SAMPLE]["minimum_us"] >= timed["DAQP: prepare"]["minimum_us"]
    for name in (SAMPLE, "ProxQP: prepare + feedback + dV/dθ"):
        assert timed[name]["met"] == (timed[name]["median_us"] <= timed[name]["at_most_us"])


def test_the_alternatives_solve_the_same_samples_and_are_slower(result):
    assert result["compared"] == 5
    for key in (("DAQP: feedback", "qpsolvers, ProxQP, cold"), (SAMPLE, "IPOPT, warm started")):
        row = rows(result)[key]
        assert row["reference_solved_share"] == 1.0
        assert row["ratio"] > 5
    assert rows(result)["DAQP: feedback", "ProxQP"]["ratio"] > 1


def test_without_mpcrl_the_table_says_how_to_get_it(result):
    peers = [row for row in result["rows"] if row["reference"] == "mpcrl"]
    assert len(peers) + len(result["missing"]) == 1


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_compiled_functions_are_set_beside_the_interpreter(monkeypatch):
    monkeypatch.delenv("COSIM_COMPILE", raising=False)
    found = run()
    assert found["functions"] == "compiled"
    assert rows(found)["DAQP: prepare", "interpreter"]["ratio"] > 1.2


def test_mpcrl_is_asked_for_the_transitions_and_its_failures_are_counted(monkeypatch):
    class Agent:
        td_errors: list[float] = []  # noqa: RUF012
        seen: list[tuple[float, ...]] = []  # noqa: RUF012

        def train_one_rollout(self, rollout, episode, raises):
            assert (len(rollout), raises) == (1, False)
            self.seen += rollout
            self.td_errors.append(np.nan if len(self.seen) == 2 else 1.0)

    module = types.ModuleType("controllers.mpcrl_nmpc")
    module.q_learning_agent = lambda problem, update_every, **options: Agent()
    monkeypatch.setitem(sys.modules, "controllers.mpcrl_nmpc", module)
    visits = [references.Visit(None, k, k + 1, k + 2, k + 3) for k in range(3)]
    seconds, solved = references._mpcrl(Scenario.load("paper"), visits)
    assert (len(seconds), solved) == (3, 2)
    assert Agent.seen == [(0, 1, 2, 3), (1, 2, 3, 4), (2, 3, 4, 5)]


@pytest.mark.slow
def test_mpcrls_problem_is_ours():
    pytest.importorskip("mpcrl")
    from controllers.mpcrl_nmpc import q_learning_agent

    problem = Problem.from_scenario(Scenario.load("paper"))
    agent = q_learning_agent(problem)
    theirs, solution = agent.state_value(np.array([26.0, 50.5]), deterministic=True)
    ours = ConvergedNmpc(problem, Parameters.naive(problem))
    ours.prepare()
    found = ours.feedback(np.array([26.0, 50.5]))
    offset = problem.reference_cost * (1 / (1 - problem.discount) - 1)
    np.testing.assert_allclose(theirs.full().ravel(), found.action, rtol=1e-5)
    # IPOPT as it comes relaxes every bound by 1e-8.
    assert float(solution.f) == pytest.approx(found.value + offset, rel=1e-7)
