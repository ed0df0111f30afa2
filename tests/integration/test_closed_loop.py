"""The RTI-NMPC on the FMU: it settles where it should, and never fails over a long run."""

import numpy as np
import pytest

from controllers import ConvergedNmpc, Parameters, Problem, RtiNmpc
from controllers.factories import naive
from controllers.qp import make_backend
from cosim import FmuPlant, simulate

STARTS = [
    [concentration, pressure]
    for concentration in (25.0, 45.0, 100.0)
    for pressure in (40.0, 49.743, 60.0, 80.0)
]


@pytest.fixture(scope="module")
def nominal():
    with FmuPlant("nominal") as plant:
        yield plant


@pytest.fixture(scope="module")
def paper():
    with FmuPlant("paper") as plant:
        yield plant


class Counting:
    """A backend that counts the QPs it is given."""

    solved = 0

    def __init__(self, name):
        self._backend = make_backend(name)
        self.load = self._backend.load

    def solve(self, qp):
        Counting.solved += 1
        return self._backend.solve(qp)


def settle(plant, controller, start, steps=700):
    """The naive cost is slow: from the far corner its error halves every 37 samples."""
    problem = controller.problem
    controller.reset()
    s = plant.reset(0, start)
    for _ in range(steps):
        controller.prepare()
        solution = controller.feedback(s)
        s = plant.step(solution.action).s
    np.testing.assert_allclose(s, problem.reference_state, rtol=0, atol=1e-3)
    np.testing.assert_allclose(solution.action, problem.reference_action, rtol=0, atol=1e-3)


@pytest.mark.slow
def test_from_any_feasible_start_it_settles_at_the_economic_steady_state(nominal):
    controller = naive(nominal.scenario)
    for start in STARTS:
        settle(nominal, controller, start)


@pytest.mark.slow
def test_with_the_exact_hessian_it_settles_too(nominal):
    problem = Problem.from_scenario(nominal.scenario)
    controller = RtiNmpc(problem, Parameters.naive(problem), hessian="exact")
    for start in STARTS[1:8:4]:
        settle(nominal, controller, start)


def test_solved_to_convergence_it_settles_too(nominal):
    problem = Problem.from_scenario(nominal.scenario)
    controller = ConvergedNmpc(problem, Parameters.naive(problem))
    settle(nominal, controller, STARTS[5], steps=400)


@pytest.mark.parametrize(
    ("backend", "steps"),
    [
        ("daqp", 1000),
        pytest.param("daqp", 10_000, marks=pytest.mark.slow),
        pytest.param("proxqp", 10_000, marks=pytest.mark.slow),
    ],
)
def test_thousands_of_samples_take_one_qp_each_solved_to_a_millionth(backend, steps, paper):
    problem = Problem.from_scenario(paper.scenario)
    controller = RtiNmpc(problem, Parameters.naive(problem), backend=lambda: Counting(backend))
    Counting.solved = 0
    trajectory = simulate(paper, controller, steps, 1)
    assert Counting.solved == steps
    assert trajectory.summary()["failures"] == 0
    assert trajectory["residual"].max() <= 1e-6
    assert set(trajectory.status) == {"solved"}
    assert trajectory["violation"].max() > 0.1
