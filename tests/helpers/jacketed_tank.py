"""A tank that the water in its jacket heats, as a plant of one action."""

import casadi as ca
import numpy as np

from controllers import Model, Quantity
from controllers.problem import Problem


def jacketed_tank() -> Problem:
    """The problem: one action, and two disturbances that reach two states by one product.

    Of its linearisation gcc 12 has lost every store at -O2. Its prediction errors are nearly
    multiples of each other, and its cost is known exactly.
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
