"""The controller's model of the quadruple tank of Johansson (2000)."""

from __future__ import annotations

import casadi as ca

from controllers.model import Model, Quantity

GRAVITY = 981.0  # cm/s²


def _ode(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """Rates of the four levels per second; `d` is the water drawn from the lower tanks."""
    areas = p[:4]
    holes = p[4:8]
    k1, k2 = ca.vertsplit(p[8:10])
    split1, split2 = ca.vertsplit(p[10:])

    # Torricelli's law; the least level keeps the root differentiable in an empty tank.
    level = ca.fmax(x, 1e-3)
    out = holes * ca.sqrt(2 * GRAVITY * level)
    out3 = out[2]
    out4 = out[3]
    # Each pump feeds a lower tank and, crosswise, the upper one over the other lower tank.
    pump1 = k1 * u[0]
    pump2 = k2 * u[1]
    to_lower1 = split1 * pump1
    to_lower2 = split2 * pump2
    to_upper3 = (1 - split2) * pump2
    to_upper4 = (1 - split1) * pump1
    # An upper tank drains into the lower one below it.
    inflow = ca.vertcat(
        out3 + to_lower1 - d[0],
        out4 + to_lower2 - d[1],
        to_upper3,
        to_upper4,
    )
    return (inflow - out) / areas


def _economic_cost(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """The squares of the pumps' voltages."""
    v1, v2 = ca.vertsplit(u)
    return v1**2 + v2**2


def model() -> Model:
    """Four tanks, two pumps, each of which feeds a lower and an upper tank; time in seconds."""
    return Model(
        name="tanks",
        # In the economic tuning one unit of each state and action weighs the same.
        states=(
            Quantity("h1", "cm", 10.0, deviation=1.0),
            Quantity("h2", "cm", 10.0, deviation=1.0),
            Quantity("h3", "cm", 10.0, deviation=1.0),
            Quantity("h4", "cm", 10.0, deviation=1.0),
        ),
        actions=(
            Quantity("v1", "V", 3.0, deviation=1.0),
            Quantity("v2", "V", 3.0, deviation=1.0),
        ),
        disturbances=(
            Quantity("d1", "cm3/s", 3.0),
            Quantity("d2", "cm3/s", 3.0),
        ),
        parameters=(
            Quantity("A1", "cm2", 28.0),
            Quantity("A2", "cm2", 32.0),
            Quantity("A3", "cm2", 28.0),
            Quantity("A4", "cm2", 32.0),
            Quantity("a1", "cm2", 0.071),
            Quantity("a2", "cm2", 0.057),
            Quantity("a3", "cm2", 0.071),
            Quantity("a4", "cm2", 0.057),
            Quantity("k1", "cm3/(V.s)", 3.33),
            Quantity("k2", "cm3/(V.s)", 3.35),
            Quantity("split1", "1", 0.70),
            Quantity("split2", "1", 0.60),
        ),
        ode=_ode,
        economic_cost=_economic_cost,
        time_unit=1.0,
        uncertain=("k1", "k2"),  # pumps wear
    )
