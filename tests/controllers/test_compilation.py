import json
import shutil
import sys

import numpy as np
import pytest

from controllers import (
    ControllerError,
    ConvergedNmpc,
    Parameters,
    Problem,
    RtiNmpc,
    ThetaBlocks,
)
from controllers import functions as compilation
from controllers.functions import BufferedFunction, Compilation, description
from controllers.shared_library import find, find_compiler
from cosim.files import TAG
from cosim.scenario import Scenario
from cosim.scenario.loading import presets
from tests.helpers.command import run_cosim
from tests.helpers.sampling import evaporator_problem

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


def small_function(name="small"):
    import casadi as ca

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


def libraries(folder):
    if not folder.is_dir():
        return []
    return [p for p in folder.iterdir() if p.suffix != ".lock" and p.name != TAG]


@needs_compiler
def test_a_compiled_function_gives_the_interpreters_bytes(folder, rng):
    interpreted, compiled = small_function(), small_function()
    assert Compilation([compiled]).finish() == "compiled"
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
        assert controller.compilation.mode == {"never": "interpreted", "now": "compiled"}[mode]
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
def test_a_long_run_is_compiled_while_it_goes_on_and_the_next_one_finds_the_library(folder):
    first = Compilation([small_function()])
    while first._build is None:
        assert first._calls <= compilation.WORTH
        first.count()
    first._build.done(wait=True)
    for _ in range(compilation.POLL):
        first.count()
    assert first.mode == "compiled"
    second = Compilation([small_function()])
    for _ in range(compilation.LOOK - 1):
        second.count()
    assert second.mode == "interpreted"
    second.count()
    assert second.mode == "compiled"
    assert len(libraries(folder)) == 1


def test_a_short_run_starts_no_compiler(folder):
    run = Compilation([small_function()])
    for _ in range(compilation.WORTH - 1):
        run.count()
    assert run.mode == "interpreted"
    assert libraries(folder) == []


@needs_compiler
@pytest.mark.parametrize("damage", ["flip", "cut", "open to others"])
def test_a_damaged_or_foreign_library_is_not_loaded(folder, damage):
    # Not loaded before it is damaged: a process does not survive damage to what it runs.
    run = Compilation([small_function()])
    run._prepare()
    run._start()
    run._build.done(wait=True)
    path = run._build.publish()
    content = path.read_bytes()
    if damage == "flip":
        path.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    elif damage == "cut":
        path.write_bytes(content[:100])
    else:
        path.chmod(0o777)
    assert find(run._name, folder) is None
    again = Compilation([small_function()])
    assert again.finish() == "compiled"
    assert find(run._name, folder) is not None


def test_without_a_compiler_the_interpreter_works_and_says_so(folder, monkeypatch):
    monkeypatch.setattr(compilation, "find_compiler", lambda chosen=None: None)
    assert Compilation([small_function()]).finish() == "interpreted"
    assert "no C compiler" in description()


def test_a_compiler_that_fails_leaves_the_interpreter(folder, monkeypatch):
    monkeypatch.setenv("CC", shutil.which("false") or sys.executable)
    assert Compilation([small_function()]).finish() == "interpreted"
    assert libraries(folder) == []


@needs_compiler
def test_a_postponed_compilation_waits_to_be_finished(folder):
    Compilation([small_function()]).finish()
    run = Compilation([small_function()])
    run.postpone()
    for _ in range(2 * compilation.LOOK):
        run.count()
    assert run.mode == "interpreted"
    assert run.finish() == "compiled"


def test_never_means_never(folder, monkeypatch):
    monkeypatch.setenv("COSIM_COMPILE", "never")
    assert Compilation([small_function()]).finish() == "interpreted"
    assert libraries(folder) == []


def test_an_unknown_word_in_the_switch_is_refused(monkeypatch):
    monkeypatch.setenv("COSIM_COMPILE", "yes")
    with pytest.raises(ControllerError, match="COSIM_COMPILE is 'yes'; it must be auto"):
        RtiNmpc(evaporator_problem(), Parameters.naive(evaporator_problem()))


def test_another_compiler_or_other_flags_do_not_share_a_library(folder, monkeypatch, tmp_path):
    other = tmp_path / "cc"
    other.write_text("#!/bin/sh\n")
    other.chmod(0o700)
    names = set()
    for chosen in (None, str(other)):
        if chosen:
            monkeypatch.setenv("CC", chosen)
        run = Compilation([small_function()])
        if run._prepare():
            names.add(run._name)
    monkeypatch.setattr(compilation, "FLAGS", ("-O0",))
    run = Compilation([small_function()])
    run._prepare()
    names.add(run._name)
    assert len(names) == 3 - (find_compiler() is None)


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
