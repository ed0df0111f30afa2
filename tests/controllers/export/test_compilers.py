"""A compiler's optimisations change no result of a controller in C."""

import shutil
import subprocess

import casadi as ca
import numpy as np

from controllers import Model, Parameters, Quantity, ThetaBlocks
from controllers.export import core, plain_c
from controllers.problem import Problem
from cosim import Scenario
from tests.helpers.compiler import needs_compiler

# The compiler itself: tests/conftest.py puts one before it that optimises nothing.
CC = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
pytestmark = needs_compiler


def _jacketed_tank() -> Problem:
    """A tank that the water in its jacket heats: one action, which one of two states feels.

    Of its linearisation gcc 12 has lost every store at -O2, and the QP then was solved in no
    iteration with the status of success.
    """

    def ode(x, u, d, p):
        tank, jacket = ca.vertsplit(x)
        feed, feed_temperature = ca.vertsplit(d)
        heat_capacity, transfer = ca.vertsplit(p)
        heat = transfer * (jacket - tank)
        return ca.vertcat(
            feed / 200 * (feed_temperature - tank) + heat / (200 * heat_capacity),
            u / 40 * (90 - jacket) - heat / (40 * heat_capacity),
        )

    model = Model(
        name="jacketed tank",
        states=(Quantity("T", "degC", 65.0), Quantity("Tj", "degC", 80.0)),
        actions=(Quantity("Fj", "L/min", 30.0),),
        disturbances=(Quantity("F", "L/min", 8.0), Quantity("Tin", "degC", 20.0, magnitude=30.0)),
        parameters=(Quantity("c", "kW.min/(L.K)", 0.0697), Quantity("UA", "kW/K", 1.5)),
        ode=ode,
        economic_cost=lambda x, u, d, p: p[0] * u * (90 - x[1]) + 0.002 * u**2,
        time_unit=60.0,
    )
    return Problem(
        model=model,
        sampling_time=60.0,
        horizon=10,
        discount=0.99,
        state_lower=np.array([60.0, 20.0]),
        state_upper=np.array([85.0, 90.0]),
        action_lower=np.array([0.0]),
        action_upper=np.array([80.0]),
        penalty_linear=np.array([500.0, 30.0]),
        penalty_quadratic=np.array([1.0, 1.0]),
        reference_state=np.array([63.17244987426528, 79.22108857417015]),
        reference_action=np.array([32.04215948616233]),
        reference_cost=26.126358018931246,
        substeps=4,
    )


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
    problem = _jacketed_tank()
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
