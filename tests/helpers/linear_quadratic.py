"""A linear-quadratic task in which the NMPC's function class contains the exact Q."""

import casadi as ca
import numpy as np
from scipy.linalg import solve_discrete_are

from controllers.model import Model, Quantity, discretise
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.core.protocols import Step
from cosim.core.scenario import Scenario

A_CONTINUOUS = np.array([[-0.2, 0.6], [-0.4, 0.1]])
B_CONTINUOUS = np.array([[0.1], [0.8]])
STATE_COST = np.array([[2.0, 0.3], [0.3, 1.0]])
ACTION_COST = np.array([[0.5]])
DISCOUNT = 0.95


def _ode(x, u, d, p):
    return ca.DM(A_CONTINUOUS) @ x + ca.DM(B_CONTINUOUS) @ u


def _cost(x, u, d, p):
    return x.T @ ca.DM(STATE_COST) @ x + u.T @ ca.DM(ACTION_COST) @ u


def model():
    """The task's own model."""
    return Model(
        name="linear",
        states=(Quantity("x1", "1"), Quantity("x2", "1")),
        actions=(Quantity("u", "1"),),
        disturbances=(),
        parameters=(),
        ode=_ode,
        economic_cost=_cost,
        time_unit=60.0,
    )


class LinearQuadratic:
    """Plant, scenario, problem and Riccati solution; noise w ~ N(0, noise²·I) on the next state."""

    def __init__(self):
        self.scenario = Scenario.from_dict(
            {
                "schema": 1,
                "name": "linear-quadratic",
                "sampling_time": 30.0,
                "discount": DISCOUNT,
                "plant": {
                    "fmu": "none.fmu",
                    "states": ["x1", "x2"],
                    "actions": ["u"],
                    "stage_cost": "cost",
                    "initial_state": [1.0, -1.0],
                },
                "bounds": {
                    "state_lower": [-30.0, -30.0],
                    "state_upper": [30.0, 30.0],
                    "action_lower": [-30.0],
                    "action_upper": [30.0],
                },
                "penalty": {"linear": [1e5, 1e5], "quadratic": [1.0, 1.0]},
                "controller": {
                    "model": "tests.helpers.linear_quadratic:model",
                    "horizon": 3,
                    "reference_state": [0.0, 0.0],
                    "reference_action": [0.0],
                    "reference_cost": 0.0,
                },
            }
        )
        scenario = self.scenario
        self.problem = Problem.from_scenario(scenario)
        step = discretise(model(), scenario.sampling_time, 2)
        none = np.zeros(0)
        columns = [np.array(step(e, [0.0], none, none)).ravel() for e in np.eye(2)]
        self.A = np.array(columns).T
        self.B = np.array(step([0.0, 0.0], [1.0], none, none)).reshape(2, 1)
        self.P, self.K = self.riccati(DISCOUNT)

    def riccati(self, discount, gain=1.0):
        """P and K of min Σ γᵏ ℓ: V = sᵀPs, u = −Ks, by SciPy's Riccati solver."""
        root = np.sqrt(discount)
        A, B = root * self.A, root * gain * self.B
        P = solve_discrete_are(A, B, STATE_COST, ACTION_COST)
        return P, np.linalg.solve(ACTION_COST + B.T @ P @ B, B.T @ P @ A)

    def exact(self):
        """θ whose Q is the exact one."""
        stage = np.zeros((3, 3))
        stage[:2, :2], stage[2:, 2:] = STATE_COST, ACTION_COST
        return Parameters.naive(self.problem).replace({"B_l": stage, "B_Vf": self.P})

    def wrong(self):
        """A θ to start from: identity Hessians and an offset model."""
        return Parameters.naive(self.problem)

    def plant(self, noise=0.0, seed=0, constant=0.0, gain=1.0):
        """The plant: `constant` is added to each sample's cost, `gain` is its B over the task's."""
        return _Plant(self, noise, seed, constant, gain)


class _Plant:
    def __init__(self, task, noise, seed, constant, gain):
        self.scenario, self._task, self._constant = task.scenario, task, constant
        self._B = gain * task.B
        self._noise, self._rng = noise, np.random.default_rng(seed)

    def reset(self, seed=0):
        self._rng = np.random.default_rng(seed)
        self._s = self.scenario.initial_state.copy()
        return self._s

    def step(self, a):
        s = self._s
        cost = float(s @ STATE_COST @ s + a @ ACTION_COST @ a)
        cost += self._constant
        w = self._noise * self._rng.standard_normal(2)
        self._s = self._task.A @ s + self._B @ a + w
        return Step(self._s, cost, 0.0, np.zeros(0))
