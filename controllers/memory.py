"""A disturbance with a memory in a model: one more state, the filter's value in the sample before.

With time constant T, sampling time h and draw w_k the disturbance is nominal + range·x_k with
x_k = φ x_{k−1} + √(1 − φ²) w_k and φ = exp(−h/T). In sample k the state ξ = x_{k−1} is known, the
draw is not: ξ₊ = x_k.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt

import casadi as ca

from controllers.model import Model, Quantity


@dataclass(frozen=True)
class Memory:
    """The filter of one disturbance of a model.

    Attributes:
        disturbance: its index.
        state: index of the filter's value ξ among the states.
        phi: φ, in (0, 1).
    """

    disturbance: int
    state: int
    phi: float

    def next_value(self, x: ca.SX, d: ca.SX) -> ca.SX:
        """ξ₊ = φ ξ + √(1 − φ²) w.

        Args:
            x: states, (n,).
            d: disturbances, of which this one is the draw w, (n_d,).
        """
        # With this gain the filter's value has the variance of the draws.
        gain = sqrt(1.0 - self.phi**2)
        xi = x[self.state]
        draw = d[self.disturbance]
        return self.phi * xi + gain * draw


def remember(
    model: Model,
    memory: Memory,
    nominal: float,
    spread: float,
) -> Model:
    """The model with the filter's value as its last state, and the draw as the disturbance.

    Its `ode` holds ξ: that changes at the end of a sample alone, by `Memory.next_value`.

    Args:
        model: in which the disturbance has no memory.
        memory: the filter; its state is the one after those of the model.
        nominal: the disturbance's nominal value.
        spread: its range.
    """

    def realised(x: ca.SX, d: ca.SX) -> ca.SX:
        """Disturbances in their units: that of a sample is constant in it, as ξ and w are."""
        values = ca.vertsplit(d)
        filtered = memory.next_value(x, d)
        values[memory.disturbance] = nominal + spread * filtered
        return ca.vertcat(*values)

    def ode(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
        of_model = x[:-1]
        disturbances = realised(x, d)
        rate = model.ode(of_model, u, disturbances, p)
        # ξ is held within a sample.
        return ca.vertcat(rate, 0)

    def economic_cost(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
        of_model = x[:-1]
        disturbances = realised(x, d)
        return model.economic_cost(of_model, u, disturbances, p)

    name = model.disturbances[memory.disturbance].name
    filtered_value = Quantity(f"memory of {name}", "1")
    return Model(
        name=f"{model.name} with a memory of {name}",
        states=(*model.states, filtered_value),
        actions=model.actions,
        disturbances=model.disturbances,
        parameters=model.parameters,
        ode=ode,
        economic_cost=economic_cost,
        time_unit=model.time_unit,
    )
