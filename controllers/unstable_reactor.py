"""The controller's model of the unstable reactor: mass and heat balances, nominal feed."""

from __future__ import annotations

import casadi as ca

from controllers.model import Model, Quantity


def _ode(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """Rates of concentration, temperature and jacket temperature per minute."""
    cA, T, Tj = ca.vertsplit(x)
    q, Tc = ca.vertsplit(u)
    cAf, Tf = ca.vertsplit(d)
    V, k0, E, heat, diffusion, UA, coolant, jacket, *_ = ca.vertsplit(p)
    k = k0 * ca.exp(-E / T)
    rate = k * diffusion / (k + diffusion) * cA
    return ca.vertcat(
        q / V * (cAf - cA) - rate,
        q / V * (Tf - T) + heat * rate + UA * (Tj - T),
        coolant * (Tc - Tj) + jacket * (T - Tj),
    )


def _economic_cost(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """Feed, pumping and cooling less the product, per minute."""
    cA = x[0]
    q, Tc = ca.vertsplit(u)
    cAf, Tf = ca.vertsplit(d)
    feed, pump, cooling, fixed = ca.vertsplit(p[8:])
    product = q * (cAf - cA)
    quadratic = pump * q**2 + cooling * (Tf - Tc) ** 2
    return fixed + feed * q * cAf - product + quadratic


def model() -> Model:
    """An exothermic reaction A → B at an unstable steady state; time in minutes."""
    return Model(
        name="unstable reactor",
        states=(
            Quantity("cA", "mol/L", 0.35),
            Quantity("T", "K", 350.0),
            Quantity("Tj", "K", 315.0),
        ),
        actions=(Quantity("q", "L/min", 50.0), Quantity("Tc", "K", 290.0)),
        disturbances=(
            Quantity("cAf", "mol/L", 1.0),
            # Counted from the temperature of the surroundings, 300 K.
            Quantity("Tf", "K", 350.0, magnitude=50.0),
        ),
        parameters=(
            Quantity("V", "L", 100.0),
            Quantity("k0", "1/min", 7.2e10),
            Quantity("E", "K", 8750.0),
            Quantity("heat", "K.L/mol", 209.2),
            Quantity("diffusion", "1/min", 40.0),
            Quantity("UA", "1/min", 2.09),
            Quantity("coolant", "1/min", 2.0),
            Quantity("jacket", "1/min", 1.5),
            Quantity("feed_price", "1", 0.02),
            Quantity("pump_price", "1", 0.002),
            Quantity("cooling_price", "1", 0.002),
            Quantity("fixed_cost", "1", 50.0),
        ),
        ode=_ode,
        economic_cost=_economic_cost,
        time_unit=60.0,
        uncertain=("UA",),  # the jacket fouls
    )
