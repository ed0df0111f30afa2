"""A compiler's optimisations change no result of a controller in C."""

import shutil
import subprocess

import numpy as np

from controllers import Parameters, ThetaBlocks
from controllers.export import core, plain_c
from cosim import Scenario
from tests.helpers.compiler import needs_compiler
from tests.helpers.jacketed_tank import jacketed_tank

# The compiler itself: tests/conftest.py puts one before it that optimises nothing.
CC = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
pytestmark = needs_compiler


def _answers(folder, flag, states):
    """What the exported program prints for each state, compiled with `flag`."""
    program = folder / f"example{flag}"
    command = [CC, "-std=c99", flag, "-ffp-contract=off", "tank.c", "main.c", "-o", program, "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    lines = [" ".join(map(repr, s)) for s in states.tolist()]
    result = subprocess.run(
        [program], input="\n".join(lines), capture_output=True, text=True, check=True
    )
    return result.stdout


def test_optimisation_changes_no_bit_of_an_exported_controller(tmp_path):
    problem = jacketed_tank()
    # As in a training: θ has the slack's weights and the model's parameters too.
    blocks = ThetaBlocks.from_problem(problem, slack_weights=True, model_parameters=("c", "UA"))
    made = core(problem, Parameters.naive(problem, blocks))
    # Of the scenario there are names in comments alone.
    for name, text in plain_c(made, "tank", Scenario.load("paper")).items():
        (tmp_path / name).write_text(text)
    rng = np.random.default_rng(0)
    states = rng.uniform(problem.state_lower, problem.state_upper, (50, 2))
    expected = _answers(tmp_path, "-O1", states)
    actions = np.array([float(line.split()[0]) for line in expected.splitlines()])
    assert np.ptp(actions) > 1.0
    for flag in ("-O0", "-O2", "-O3"):
        assert _answers(tmp_path, flag, states) == expected, flag
