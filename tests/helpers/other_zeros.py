"""The presets' models counted from other zeros and in other units: gauge pressures, K for °C."""

import dataclasses
from dataclasses import dataclass

import casadi as ca
import numpy as np

from controllers import evaporator, heater, reactor, tanks, unstable_reactor
from controllers.model import discretise
from controllers.problem import Problem
from cosim.core.protocols import Step


def _recounted(quantities, factors):
    """Quantities with the deviations that they state counted otherwise."""
    recounted = []
    for quantity, factor in zip(quantities, factors, strict=True):
        deviation = quantity.deviation
        if deviation is not None:
            deviation = factor * deviation
        recounted.append(dataclasses.replace(quantity, deviation=deviation))
    return tuple(recounted)


@dataclass(frozen=True)
class Counting:
    """value there = factor · value here + zero, of states, actions and disturbances; cost factor.

    Each pair holds the factors and the zeros, in the order of the model's quantities. `factory`
    names the function below that makes the model.
    """

    factory: str
    states: tuple[list[float], list[float]]
    actions: tuple[list[float], list[float]]
    disturbances: tuple[list[float], list[float]]
    cost: float

    def there(self, kind, values):
        """Values of a kind of quantities, counted otherwise."""
        factors, zeros = getattr(self, kind)
        return np.array(factors) * np.array(values) + np.array(zeros)

    def here(self, kind, values):
        """The inverse of `there`."""
        factors, zeros = getattr(self, kind)
        return (np.array(values) - np.array(zeros)) / np.array(factors)

    def model(self, own):
        """A model, counted otherwise."""

        def here(x, u, d):
            pairs = zip((x, u, d), (self.states, self.actions, self.disturbances), strict=True)
            return [(values - ca.DM(zeros)) / ca.DM(factors) for values, (factors, zeros) in pairs]

        disturbances = []
        there = self.there("disturbances", own.nominal_disturbance)
        sizes = np.array(self.disturbances[0]) * own.disturbance_magnitudes
        for quantity, nominal, size in zip(own.disturbances, there, sizes, strict=True):
            changed = dataclasses.replace(quantity, nominal=float(nominal), magnitude=float(size))
            disturbances.append(changed)
        factors = ca.DM(self.states[0])
        return dataclasses.replace(
            own,
            states=_recounted(own.states, self.states[0]),
            actions=_recounted(own.actions, self.actions[0]),
            disturbances=tuple(disturbances),
            ode=lambda x, u, d, p: factors * own.ode(*here(x, u, d), p),
            economic_cost=lambda x, u, d, p: self.cost * own.economic_cost(*here(x, u, d), p),
        )

    def scenario(self, own):
        """A scenario, counted otherwise, with its controller's model."""
        factors = np.array(self.states[0])
        penalty = own.penalty
        controller = own.controller
        listed = {
            "bounds": {
                "state_lower": self.there("states", own.state_lower).tolist(),
                "state_upper": self.there("states", own.state_upper).tolist(),
                "action_lower": self.there("actions", own.action_lower).tolist(),
                "action_upper": self.there("actions", own.action_upper).tolist(),
            },
            "penalty": {
                "linear": (self.cost / factors * penalty.linear).tolist(),
                "quadratic": (self.cost / factors**2 * penalty.quadratic).tolist(),
            },
            "plant": {"initial_state": self.there("states", own.initial_state).tolist()},
            "controller": {
                "model": f"tests.helpers.other_zeros:{self.factory}",
                "reference_state": self.there("states", controller.reference_state).tolist(),
                "reference_action": self.there("actions", controller.reference_action).tolist(),
                "reference_cost": self.cost * controller.reference_cost,
            },
        }
        return own.replace(listed)

    def theta(self, own, blocks):
        """θ, counted otherwise: its bounds are states, all else counts from the reference."""
        theta = own.with_theta(self.factors(own.blocks) * own.theta)
        bounds = {}
        for name in ("x_l", "x_u"):
            bounds[name] = self.there("states", own[name])
        recounted = theta.replace(bounds).theta
        return dataclasses.replace(own, blocks=blocks, theta=recounted)

    def factors(self, blocks):
        """By what each entry of θ is multiplied."""
        state, action = np.array(self.states[0]), np.array(self.actions[0])
        both = np.concatenate([state, action])

        def quadratic(units):
            return (self.cost / np.outer(units, units))[np.triu_indices(units.size)]

        by_block = {
            "B_lambda": quadratic(state),
            "b_lambda": self.cost / state,
            "c_lambda": [self.cost],
            "B_Vf": quadratic(state),
            "b_Vf": self.cost / state,
            "B_l": quadratic(both),
            "b_l": self.cost / both,
            "c_f": state,
            "x_l": state,
            "x_u": state,
            "w_sigma": self.cost / state,
            "W_sigma": self.cost / state**2,
        }
        return np.concatenate([by_block[block.name] for block in blocks])

    def problems(self, own):
        """The problem of a scenario, as it is and counted otherwise."""
        return Problem.from_scenario(own), Problem.from_scenario(self.scenario(own))


class NoisyModel:
    """A plant: the evaporator's nominal model with noise on the next state.

    `counting` is that of the scenario; None: the evaporator's own.
    """

    NOISE = np.array([1.0, 0.3])

    def __init__(self, scenario, counting=None):
        self.scenario, self._counting = scenario, counting
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
        s, cost = self._s, 1.0
        if self._counting is not None:
            s, a = self._counting.here("states", s), self._counting.here("actions", a)
            cost = self._counting.cost
        stage = cost * float(self._cost(s, a, *self._given))
        penalty = self.scenario.state_penalty(self._s.tolist())
        noise = self._rng.uniform(-self.NOISE, self.NOISE)
        next_s = self._step(s, a, *self._given).full().reshape(-1) + noise
        if self._counting is not None:
            next_s = self._counting.there("states", next_s)
        self._s = next_s
        return Step(self._s, stage, penalty, np.zeros(0))


COUNTINGS = {
    # Gauge pressures in 10 kPa, ‰, t/h for kg/min, K for °C.
    "paper": Counting(
        factory="paper_model",
        states=([10.0, 0.1], [0.0, -10.1325]),
        actions=([0.1, 0.1], [-10.1325, 0.0]),
        disturbances=([10.0, 0.1, 1.0, 1.0], [0.0, 0.0, 273.15, 273.15]),
        cost=100.0,
    ),
    # °C for K.
    "reactor": Counting(
        factory="reactor_model",
        states=([1.0, 1.0], [0.0, -273.15]),
        actions=([1.0, 1.0], [0.0, -273.15]),
        disturbances=([1.0, 1.0], [0.0, -273.15]),
        cost=1.0,
    ),
    # Levels in mm above a mark.
    "tanks": Counting(
        factory="tanks_model",
        states=([10.0] * 4, [-20.0] * 4),
        actions=([1.0, 1.0], [0.0, 0.0]),
        disturbances=([10.0, 10.0], [0.0, 0.0]),
        cost=1.0,
    ),
    # Content in hg above a mark, K for °C, W for kW.
    "dead-time": Counting(
        factory="heater_model",
        states=([10.0, 1.0], [-500.0, 273.15]),
        actions=([10.0, 1000.0], [0.0, 0.0]),
        disturbances=([10.0, 1.0], [0.0, 273.15]),
        cost=10.0,
    ),
    # Pounds, °F and BTU/h: factors that are no powers of ten.
    "dead-time in pounds": Counting(
        factory="heater_model_in_pounds",
        states=([2.2046, 1.8], [0.0, 32.0]),
        actions=([2.2046, 3412.14], [0.0, 0.0]),
        disturbances=([2.2046, 1.8], [0.0, 32.0]),
        cost=0.7,
    ),
    # mmol for mol, °C for K.
    "unstable-reactor": Counting(
        factory="unstable_reactor_model",
        states=([1000.0, 1.0, 1.0], [0.0, -273.15, -273.15]),
        actions=([1.0, 1.0], [0.0, -273.15]),
        disturbances=([1000.0, 1.0], [0.0, -273.15]),
        cost=1.0,
    ),
}


def paper_model():
    """The evaporator's, counted otherwise."""
    return COUNTINGS["paper"].model(evaporator.model())


def reactor_model():
    """The reactor's, counted otherwise."""
    return COUNTINGS["reactor"].model(reactor.model())


def tanks_model():
    """The four tanks', counted otherwise."""
    return COUNTINGS["tanks"].model(tanks.model())


def heater_model():
    """The heated tank's, counted otherwise."""
    return COUNTINGS["dead-time"].model(heater.model())


def heater_model_in_pounds():
    """The heated tank's, counted otherwise again."""
    return COUNTINGS["dead-time in pounds"].model(heater.model())


def unstable_reactor_model():
    """The unstable reactor's, counted otherwise."""
    return COUNTINGS["unstable-reactor"].model(unstable_reactor.model())
