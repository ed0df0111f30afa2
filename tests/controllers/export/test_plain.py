"""The controller as plain C: built as a user builds it, held to the Python controller."""

import ctypes
import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from controllers import RtiNmpc
from controllers.errors import ControllerError
from controllers.export import core, plain_c
from controllers.factories import tuned
from cosim import FmuPlant, Scenario, simulate
from tests.helpers.command import run_here
from tests.helpers.compiler import needs_compiler

CC = os.environ.get("CC", "cc")
pytestmark = needs_compiler
FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-O1", "-ffp-contract=off")


def built(folder, *flags):
    """The example program of the C in `folder`, built."""
    program = folder / "-".join(["example", *flags])
    names = sorted(path.name for path in folder.glob("*.c"))
    subprocess.run([CC, *FLAGS, *flags, *names, "-o", program, "-lm"], cwd=folder, check=True)
    return program


def rows(program, states):
    """Action, status, iterations and value of each sample."""
    text = "\n".join(" ".join(map(repr, s)) for s in np.asarray(states).tolist())
    result = subprocess.run([program], input=text, capture_output=True, text=True, check=True)
    return np.array([list(map(float, line.split())) for line in result.stdout.splitlines()])


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain") / "evaporator_nmpc"
    run_here("export", "tuned", "--format", "c", "--out", folder, "--json").check_returncode()
    return folder


@pytest.fixture(scope="module")
def example(exported):
    return built(exported)


def test_the_program_gives_the_actions_of_the_python_controller(example):
    scenario = Scenario.load("paper")
    with FmuPlant(scenario) as plant:
        run = simulate(plant, tuned(scenario), 200, 4)
    states = np.stack([run[name] for name in scenario.plant.states], axis=1)
    found = rows(example, states)
    expected = np.stack([run[name] for name in scenario.plant.actions], axis=1)
    np.testing.assert_allclose(found[:, :2], expected, rtol=0, atol=1e-10)
    assert set(found[:, 2]) == {0}


def test_a_failed_sensor_holds_the_action_and_the_iteration_cap_is_a_failure(exported, example):
    first, failed, after = rows(example, [(25, 50), (np.nan, 50), (25, 50)])
    assert (failed[2], after[2]) == (3, 0)
    np.testing.assert_array_equal(failed[:2], first[:2])
    capped = rows(built(exported, "-DQP_ITERATIONS=1"), [(10, 30)])
    assert capped[0, 2] == 2


@pytest.mark.slow
def test_automatic_goes_on_from_what_the_operator_did_in_manual(exported):
    library = exported / "library.so"
    subprocess.run(
        [CC, *FLAGS, "-fPIC", "-shared", "evaporator_nmpc.c", "-o", library, "-lm"], cwd=exported,
        check=True,
    )  # fmt: skip
    calls, controller = ctypes.CDLL(str(library)), ctypes.create_string_buffer(1 << 16)
    calls.evaporator_nmpc_init(controller)
    scenario = Scenario.load("paper")
    python, action = tuned(scenario), np.zeros(2)
    states = np.random.default_rng(1).normal((25.5, 50.0), (0.5, 1.0), (12, 2))
    for k, s in enumerate(states):
        manual = 4 <= k < 8
        if k in (5, 6):
            action[:] = [(230.0, 190.0), (500.0, 0.0)][k - 5]  # at k = 4 the last one stays
        given = np.clip(action, scenario.action_lower, scenario.action_upper) if manual else None
        call = calls.evaporator_nmpc_manual if manual else calls.evaporator_nmpc_step
        pointers = [ctypes.c_void_p(array.ctypes.data) for array in (s, action)]
        assert call(controller, *pointers) == 0
        python.prepare()
        expected = python.feedback(s, given).action
        np.testing.assert_allclose(action, expected, rtol=0, atol=1e-10)
        if manual:
            np.testing.assert_array_equal(action, given)


def test_it_calls_no_more_than_it_says(exported):
    """No allocation, no input or output; of libm what the header lists."""
    subprocess.run(
        [CC, "-std=c99", "-O2", "-c", "evaporator_nmpc.c", "-o", "object.o"], cwd=exported,
        check=True,
    )  # fmt: skip
    result = subprocess.run(
        ["nm", "-u", exported / "object.o"], capture_output=True, text=True, check=True
    )
    called = set(re.findall(r" U (\w+)", result.stdout)) - {"_GLOBAL_OFFSET_TABLE_"}
    assert called <= {"memcpy", "memmove", "memset", "sqrt", "copysign", "__stack_chk_fail"}
    header = (exported / "evaporator_nmpc.h").read_text()
    assert "EVAPORATOR_NMPC_STATES = 2,  /* X2, P2 */" in header


@pytest.mark.slow
def test_in_single_precision_a_loop_has_its_actions_and_a_wild_state_is_held(tmp_path, example):
    folder = tmp_path / "single_nmpc"
    words = ("export", "tuned", "--format", "c", "--single", "--out", folder)
    run_here(*words).check_returncode()
    command = [CC, *FLAGS, "-O0", "-Wdouble-promotion", "-c", "single_nmpc.c", "-o", "object.o"]
    subprocess.run(command, cwd=folder, check=True)
    program = built(folder)
    states = np.random.default_rng(0).normal((25.4, 49.8), (0.3, 0.3), (200, 2))
    found, expected = rows(program, states), rows(example, states)
    assert set(found[:, 2]) == {0}
    np.testing.assert_allclose(found[:, :2], expected[:, :2], rtol=0, atol=1e-3)
    assert not np.array_equal(found[:, :2], expected[:, :2])
    held = rows(program, [(25.0, 50.0), (1e30, 1e30)])
    assert held[1, 2] != 0
    np.testing.assert_array_equal(held[1, :2], held[0, :2])
    failed = run_here("export", "tuned", "--single", "--out", tmp_path / "c.fmu")
    assert (failed.returncode, "--single goes with --format c" in failed.stderr) == (2, True)


@pytest.mark.slow
def test_two_controllers_link_into_one_program(exported, tmp_path):
    for name in ("one", "other"):
        scenario = Scenario.load("paper").replace({"controller": {"horizon": 2}})
        controller = tuned(scenario)
        assert type(controller) is RtiNmpc
        files = plain_c(core(controller.problem, controller.parameters), name, scenario)
        for file in (f"{name}.c", f"{name}.h"):
            (tmp_path / file).write_text(files[file])
    calls = "static One a; static Other b; one_init(&a); other_init(&b); return 0;"
    text = f'#include "one.h"\n#include "other.h"\nint main(void) {{ {calls} }}\n'
    (tmp_path / "main.c").write_text(text)
    built(tmp_path)
    with pytest.raises(ControllerError, match="no name for C"):
        plain_c(core(controller.problem, controller.parameters), "1x", scenario)


SANITISED = (
    "-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all",
)  # fmt: skip


@pytest.mark.sanitised
@pytest.mark.parametrize("hessian", ["gauss-newton", pytest.param("exact", marks=pytest.mark.slow)])
def test_sanitizers_find_nothing_and_change_no_bit(tmp_path, hessian):
    """Good and wild states and θ, automatic and manual; scratch static and on the stack."""
    scenario = Scenario.load("paper")
    controller = tuned(scenario)
    exported = core(controller.problem, controller.parameters, hessian)
    files = plain_c(exported, "soaked", scenario)
    for file in ("soaked.c", "soaked.h"):
        (tmp_path / file).write_text(files[file])
    shutil.copy(Path(__file__).with_name("soak.c"), tmp_path)
    lines = []
    for flags in (("-O2",), SANITISED, (*SANITISED, "-DQP_SCRATCH=")):
        result = subprocess.run(
            [built(tmp_path, *flags), "20000"], capture_output=True, text=True, check=False
        )
        assert result.returncode == 0, result.stderr
        lines.append(result.stdout)
    assert lines[1:] == lines[:1] * 2
    assert 0 < int(lines[0].split()[1]) < 20000


@pytest.mark.slow
def test_the_worst_case_of_the_qp_solver(exported):
    """Iterations over states about and beyond the bounds, each a jump from the one before."""
    rng = np.random.default_rng(0)
    states = rng.uniform((15, 35), (40, 80), (20_000, 2))
    found = rows(built(exported), states)
    print(f"\nworst of {len(found)}: {found[:, 3].max():.0f} iterations, mean {found[:, 3].mean()}")
    assert set(found[:, 2]) == {0}
    assert found[:, 3].max() < 100
