"""Compiled functions: the interpreter's bytes, a cache, no endless wait."""

import json
import shutil
import sys

import casadi as ca
import numpy as np
import pytest

from controllers import (
    ConvergedNmpc,
    Parameters,
    Problem,
    RtiNmpc,
    ThetaBlocks,
    functions,
)
from controllers.functions import BufferedFunction, bind_compiled, find_compiler
from cosim.scenario import Scenario, presets
from tests.helpers.command import run_cosim
from tests.helpers.sampling import evaporator_problem

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def small_function(name="small"):
    x = ca.SX.sym("x", 3)
    values = [
        ca.sin(x[0]) * x[1] + x[2] * x[1],
        ca.fmax(x[0], x[1]),
        ca.fmin(x[1], x[0]),
        x[2] ** 3,
    ]
    return BufferedFunction(ca.Function(name, [x], [ca.vertcat(*values)], ["x"], ["y"]))


@pytest.fixture
def folder(monkeypatch, tmp_path):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("COSIM_COMPILE", raising=False)
    return tmp_path / "cache" / "compiled"


@needs_compiler
def test_a_compiled_function_gives_the_interpreters_bytes(folder, rng):
    interpreted, compiled = small_function(), small_function()
    assert bind_compiled([compiled]) == "compiled"
    ties = [(0.0, -0.0, 1.0), (-0.0, 0.0, 1.0), (np.nan, 1.0, -1.0), (1.0, np.nan, np.inf)]
    for values in [*ties, *rng.normal(size=(200, 3)) * 10.0 ** rng.integers(-8, 8, (200, 1))]:
        for function in (interpreted, compiled):
            function.inputs["x"][:] = values
            function()
        assert interpreted.outputs["y"].tobytes() == compiled.outputs["y"].tobytes()


@needs_compiler
@pytest.mark.parametrize("kind", ["gauss-newton", "exact", "converged"])
def test_a_compiled_controller_gives_the_interpreters_bytes(monkeypatch, kind):
    compare(monkeypatch, kind, evaporator_problem(horizon=3))


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("scenario", presets())
@pytest.mark.parametrize("kind", ["gauss-newton", "exact", "converged"])
def test_so_it_does_for_every_preset(monkeypatch, kind, scenario):
    compare(monkeypatch, kind, Problem.from_scenario(Scenario.load(scenario)))


def compare(monkeypatch, kind, problem):
    rows = {}
    for mode in ("never", "now"):
        monkeypatch.setenv("COSIM_COMPILE", mode)
        parameters = Parameters.naive(problem, ThetaBlocks.of(problem, slack_weights=True))
        controller = (
            ConvergedNmpc(problem, parameters)
            if kind == "converged"
            else RtiNmpc(problem, parameters, hessian=kind)
        )
        assert controller.functions == {"never": "interpreted", "now": "compiled"}[mode]
        rows[mode] = visits(controller, np.random.default_rng(5))
    assert rows["never"] == rows["now"]


def visits(controller, rng):
    """Bytes of all that a controller gives along a walk of the state."""
    rows, s = [], controller.problem.reference_state
    for _ in range(8):
        s = s + rng.normal(size=2) * (0.2, 1.0)
        controller.prepare()
        solution = controller.feedback(s)
        explored = controller.feedback(s, np.clip(solution.action + rng.normal(size=2), 100, 400))
        arrays = (
            solution.action,
            solution.value_gradient,
            solution.policy_jacobian,
            solution.policy_state_jacobian,
            solution.predicted_states,
            solution.costates,
            explored.value_gradient,
        )
        rows.append((solution.value, explored.value, *(array.tobytes() for array in arrays)))
    return rows


@needs_compiler
def test_a_long_run_compiles_and_a_shorter_one_finds_the_library(folder):
    assert bind_compiled([small_function()], functions.LONG - 1) == "interpreted"
    assert bind_compiled([small_function()], functions.LONG) == "compiled"
    assert bind_compiled([small_function()], functions.LOOK) == "compiled"
    assert bind_compiled([small_function()], functions.LOOK - 1) == "interpreted"
    assert len(list(folder.glob("*.lib"))) == 1


def test_a_compiler_that_fails_or_hangs_leaves_the_interpreter(folder, monkeypatch, tmp_path):
    monkeypatch.setenv("CC", shutil.which("false") or sys.executable)
    assert bind_compiled([small_function()]) == "interpreted"
    hangs = tmp_path / "cc"
    hangs.write_text("#!/bin/sh\nsleep 600\n")
    hangs.chmod(0o700)
    monkeypatch.setenv("CC", str(hangs))
    monkeypatch.setattr(functions, "PATIENCE", 0.5)
    assert bind_compiled([small_function()]) == "interpreted"
    assert list(folder.glob("*.lib")) == []


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("algorithm", ["q-learning", "batch-q-learning", "actor-critic"])
def test_training_gives_the_same_bytes_compiled_and_interpreted(tmp_path, algorithm):
    written = {}
    for mode in ("never", "now"):
        out = tmp_path / mode
        command = ["train", "--algorithm", algorithm, "--samples", "2500", "--out", str(out)]
        command += ["--evaluation-seeds", "1", "--evaluation-steps", "100"]
        run_cosim(*command, env={"COSIM_COMPILE": mode}, check=True)
        summary = json.loads((out / "summary.json").read_text())
        used = summary["timing"]["functions"]
        assert used == {"never": "interpreted", "now": "compiled"}[mode]
        written[mode] = [(out / name).read_bytes() for name in ("learning.csv", "parameters.toml")]
    assert written["never"] == written["now"]
