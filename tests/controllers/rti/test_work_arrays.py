"""Models that call tables and other functions: compiled and exported C against the interpreter."""

import subprocess

import numpy as np
import pytest

from controllers import (
    ControllerError,
    Parameters,
    QpError,
    RtiNmpc,
    ThetaBlocks,
    functions,
)
from controllers.errors import ModelWarning
from controllers.export import core
from tests.helpers.compiler import needs_compiler
from tests.helpers.models import CALLS, calling, root_finder

BOUND = 1e-9
"""Largest relative difference between compiled code and the interpreter."""
READ = ("action", "value", "value_gradient", "policy_jacobian", "predicted_states")
SANITISED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def theta(problem):
    return Parameters.naive(
        problem, ThetaBlocks.from_problem(problem, slack_weights=True, model_parameters=("p0",))
    )


def states(count, seed=1):
    return np.random.default_rng(seed).uniform(-1.2, 1.2, (count, 2))


@needs_compiler
@pytest.mark.parametrize(
    "call",
    [
        "two tables",
        *(pytest.param(call, marks=pytest.mark.slow) for call in CALLS if call != "two tables"),
    ],
)
def test_compiled_code_gives_the_interpreters_digits(call, monkeypatch):
    monkeypatch.setenv("COSIM_COMPILE", "now")
    monkeypatch.setattr(functions, "FLAGS", ("-O0", *functions.FLAGS[1:]))
    problem = calling(CALLS[call], horizon=3)
    compiled, interpreted = (RtiNmpc(problem, theta(problem)) for _ in range(2))
    compiled.compile()
    assert compiled.functions == "compiled"
    for s in states(8):
        for controller in (compiled, interpreted):
            controller.prepare()
        found, expected = compiled.feedback(s), interpreted.feedback(s)
        for name in READ:
            wanted = np.asarray(getattr(expected, name))
            scale = np.abs(wanted).max()
            np.testing.assert_allclose(getattr(found, name), wanted, rtol=0, atol=BOUND * scale)


@needs_compiler
@pytest.mark.sanitised
@pytest.mark.parametrize(
    "call",
    [
        pytest.param("two tables", marks=pytest.mark.slow),
        *(call for call in CALLS if call != "two tables"),
    ],
)
def test_sanitizers_find_nothing_in_exported_c(call, tmp_path):
    """The exact Hessian calls the model's second derivatives too.

    At random states the guess is far from the solution, and a difference of it grows: 1e-15 in the
    first state of "large graph" is 1e-5 of V forty samples later, in the interpreter alone. So both
    begin anew every `RESTART` samples.
    """
    problem = calling(CALLS[call], horizon=3)
    exported = core(problem, theta(problem), "exact")
    (tmp_path / "main.c").write_text(MAIN)
    for name, source in exported.sources.items():
        (tmp_path / name).write_bytes(source)
    command = ["cc", *SANITISED, "-ffp-contract=off", "main.c", "-o", "main", "-lm"]
    subprocess.run(command, cwd=tmp_path, check=True)
    given = states(40)
    numbers = [*exported.parameters.theta, *given.ravel()]
    text = "\n".join(repr(float(number)) for number in numbers)
    done = subprocess.run(
        [tmp_path / "main"], input=text, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    rows = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
    controller = RtiNmpc(problem, exported.parameters, hessian="exact")
    for k, (s, (status, value)) in enumerate(zip(given, rows, strict=True)):
        if k % RESTART == 0:
            controller.reset()
        controller.prepare()
        try:
            expected = controller.feedback(s).value
        except QpError:
            assert status != 0
            controller.reset()
            continue
        assert status == 0
        assert value == pytest.approx(expected, rel=1e-8)


RESTART = 8
"""Samples after which both controllers forget their guess."""

MAIN = (
    f"#define RESTART {RESTART}"
    + """
#include <stdio.h>
#include "core.h"
int main(void) {
    static CoreState state;
    double theta[N_THETA], s[N_X];
    for (int i = 0; i < N_THETA; i++)
        if (scanf("%lf", &theta[i]) != 1) return 1;
    for (int k = 0;; k++) {
        if (k % RESTART == 0) core_reset(&state);
        for (int i = 0; i < N_X; i++)
            if (scanf("%lf", &s[i]) != 1) return 0;
        core_act(&state, s, 0, theta);
        core_commit(&state);
        printf("%d %.17g\\n", (int)state.status, state.solution.value);
    }
}
"""
)


@pytest.fixture
def with_root():
    find = root_finder()
    return calling(lambda x: find(0, x[0]), horizon=2)


@needs_compiler
def test_what_cannot_be_c_is_interpreted_and_one_line_says_so(with_root, monkeypatch):
    monkeypatch.setenv("COSIM_COMPILE", "now")
    controller = RtiNmpc(with_root, Parameters.naive(with_root))
    with pytest.warns(ModelWarning, match="'root', a Newton of CasADi"):
        controller.compile()
    assert controller.functions == "interpreted"
    assert np.isfinite(controller.feedback([0.3, 0.2]).value)


def test_what_cannot_be_c_is_not_exported(with_root):
    with pytest.raises(ControllerError, match="'root', a Newton"):
        core(with_root, Parameters.naive(with_root))
