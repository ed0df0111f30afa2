"""The controller's model of the reactor: mass and heat balance, nominal feed, clean jacket."""

from __future__ import annotations

import casadi as ca

from controllers.model import Model, Quantity


def _ode(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """Rates of concentration and temperature per minute."""
    cA, T = ca.vertsplit(x)
    q, Tc = ca.vertsplit(u)
    cAf, Tf = ca.vertsplit(d)
    V, k0, E, heat, UA, *_ = ca.vertsplit(p)
    rate = k0 * ca.exp(-E / T) * cA
    return ca.vertcat(
        q / V * (cAf - cA) - rate,
        q / V * (Tf - T) + heat * rate + UA * (Tc - T),
    )


def _economic_cost(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """Feed, pumping and cooling less the product, per minute."""
    cA, _ = ca.vertsplit(x)
    q, Tc = ca.vertsplit(u)
    cAf, Tf = ca.vertsplit(d)
    feed, pump, cooling, fixed = ca.vertsplit(p[5:])
    product = q * (cAf - cA)
    quadratic = pump * q**2 + cooling * (Tf - Tc) ** 2
    return fixed + feed * q * cAf - product + quadratic


def model() -> Model:
    """An exothermic reaction A → B in a stirred tank with a cooling jacket; time in minutes."""
    return Model(
        name="reactor",
        states=(Quantity("cA", "mol/L", 0.5), Quantity("T", "K", 345.0)),
        actions=(Quantity("q", "L/min", 100.0), Quantity("Tc", "K", 320.0)),
        disturbances=(
            Quantity("cAf", "mol/L", 1.0),
            # Counted from 0 °C, as the evaporator's temperatures are.
            Quantity("Tf", "K", 350.0, magnitude=76.85),
        ),
        parameters=(
            Quantity("V", "L", 100.0),
            Quantity("k0", "1/min", 9.2e4),
            Quantity("E", "K", 4000.0),
            Quantity("heat", "K.L/mol", 120.0),
            Quantity("UA", "1/min", 2.09),
            Quantity("feed_price", "1", 0.1),
            Quantity("pump_price", "1", 0.004),
            Quantity("cooling_price", "1", 0.01),
            Quantity("fixed_cost", "1", 50.0),
        ),
        ode=_ode,
        economic_cost=_economic_cost,
        time_unit=60.0,
        uncertain=("UA",),  # the jacket fouls
    )
