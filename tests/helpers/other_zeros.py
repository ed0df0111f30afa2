"""The presets' models counted from other zeros and in other units: gauge pressures, K for °C."""

import dataclasses
from dataclasses import dataclass

import casadi as ca
import numpy as np

from controllers import evaporator, reactor, tanks


@dataclass(frozen=True)
class Counting:
    """value there = factor · value here + zero, of states, actions and disturbances; cost factor.

    Each pair holds the factors and the zeros, in the order of the model's quantities.
    """

    states: tuple[list[float], list[float]]
    actions: tuple[list[float], list[float]]
    disturbances: tuple[list[float], list[float]]
    cost: float

    def there(self, kind, values):
        """Values of a kind of quantities, counted otherwise."""
        factors, zeros = getattr(self, kind)
        return np.array(factors) * np.array(values) + np.array(zeros)

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
            disturbances=tuple(disturbances),
            ode=lambda x, u, d, p: factors * own.ode(*here(x, u, d), p),
            economic_cost=lambda x, u, d, p: self.cost * own.economic_cost(*here(x, u, d), p),
        )

    def scenario(self, own, factory):
        """A scenario, counted otherwise; `factory` names its controller's model."""
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
                "model": factory,
                "reference_state": self.there("states", controller.reference_state).tolist(),
                "reference_action": self.there("actions", controller.reference_action).tolist(),
                "reference_cost": self.cost * controller.reference_cost,
            },
        }
        return own.replace(listed)


COUNTINGS = {
    # Gauge pressures in 10 kPa, ‰, t/h for kg/min, K for °C.
    "paper": Counting(
        states=([10.0, 0.1], [0.0, -10.1325]),
        actions=([0.1, 0.1], [-10.1325, 0.0]),
        disturbances=([10.0, 0.1, 1.0, 1.0], [0.0, 0.0, 273.15, 273.15]),
        cost=100.0,
    ),
    # °C for K.
    "reactor": Counting(
        states=([1.0, 1.0], [0.0, -273.15]),
        actions=([1.0, 1.0], [0.0, -273.15]),
        disturbances=([1.0, 1.0], [0.0, -273.15]),
        cost=1.0,
    ),
    # Levels in mm above a mark.
    "tanks": Counting(
        states=([10.0] * 4, [-20.0] * 4),
        actions=([1.0, 1.0], [0.0, 0.0]),
        disturbances=([10.0, 10.0], [0.0, 0.0]),
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
