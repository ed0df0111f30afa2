"""The evaporator counted otherwise: ‰ for %, 10 kPa for kPa, 0.1 kg for kg, another currency."""

import dataclasses

import casadi as ca
import numpy as np

from controllers import evaporator
from controllers.model import discretise
from controllers.problem import Problem
from cosim.core.protocols import Step

STATE = np.array([10.0, 0.1])
ACTION = np.array([0.1, 10.0])
COST = 1000.0


def model():
    """The evaporator's model in the other units; the scenario names it."""
    own, x, u = evaporator.model(), ca.DM(STATE), ca.DM(ACTION)
    return dataclasses.replace(
        own,
        ode=lambda s, a, d, p: x * own.ode(s / x, a / u, d, p),
        economic_cost=lambda s, a, d, p: COST * own.economic_cost(s / x, a / u, d, p),
    )


def recounted(scenario):
    """The scenario in the other units."""
    settings = scenario.controller
    values = {
        "bounds": {
            "state_lower": STATE * scenario.state_lower,
            "state_upper": STATE * scenario.state_upper,
            "action_lower": ACTION * scenario.action_lower,
            "action_upper": ACTION * scenario.action_upper,
        },
        "penalty": {
            "linear": COST / STATE * scenario.penalty_linear,
            "quadratic": COST / STATE**2 * scenario.penalty_quadratic,
        },
        "plant": {"initial_state": STATE * scenario.initial_state},
        "controller": {
            "reference_state": STATE * settings.reference_state,
            "reference_action": ACTION * settings.reference_action,
            "reference_cost": np.array(COST * settings.reference_cost),
        },
    }
    listed = {table: {k: v.tolist() for k, v in part.items()} for table, part in values.items()}
    listed["controller"]["model"] = "tests.helpers.other_units:model"
    return scenario.replace(listed)


def factors(blocks, state=STATE, action=ACTION, cost=COST):
    """By what each entry of θ is multiplied when x, u and the cost are counted in other units."""
    both = np.concatenate([state, action])

    def quadratic(units):
        return (cost / np.outer(units, units))[np.triu_indices(units.size)]

    by_block = {
        "B_lambda": quadratic(state),
        "b_lambda": cost / state,
        "c_lambda": [cost],
        "B_Vf": quadratic(state),
        "b_Vf": cost / state,
        "B_l": quadratic(both),
        "b_l": cost / both,
        "c_f": state,
        "x_l": state,
        "x_u": state,
        "w_sigma": cost / state,
        "W_sigma": cost / state**2,
    }
    return np.concatenate([by_block[block.name] for block in blocks])


class NoisyModel:
    """A plant: the evaporator's nominal model with noise on the next state, in a scenario's units.

    `state`, `action` and `cost` are those of the scenario in the evaporator's own.
    """

    NOISE = np.array([1.0, 0.3])

    def __init__(self, scenario, state, action, cost):
        self.scenario, self._units = scenario, (state, action, cost)
        own = evaporator.model()
        self._step = discretise(own, scenario.sampling_time, 2)
        x, u, d, p = own.symbols()
        self._cost = ca.Function("l", [x, u, d, p], [own.economic_cost(x, u, d, p)])
        self._given = own.nominal_disturbance, own.nominal_parameters

    def reset(self, seed):
        self._rng = np.random.default_rng(seed)
        self._s = self.scenario.initial_state
        return self._s

    def step(self, a):
        state, action, cost = self._units
        s, own_a = self._s / state, a / action
        stage = cost * float(self._cost(s, own_a, *self._given))
        penalty = self.scenario.state_penalty(self._s.tolist())
        noise = self._rng.uniform(-self.NOISE, self.NOISE)
        self._s = state * (self._step(s, own_a, *self._given).full().reshape(-1) + noise)
        return Step(self._s, stage, penalty, np.zeros(0))


def problems(scenario):
    """The problem in both countings."""
    return Problem.from_scenario(scenario), Problem.from_scenario(recounted(scenario))
