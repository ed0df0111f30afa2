"""The controller's model of the reactor: mass and heat balance, nominal feed, clean jacket."""

from __future__ import annotations

import casadi as ca

from controllers.model import Model, Quantity, by_name

PARAMETERS = (
    Quantity("V", "L", 100.0),
    Quantity("k0", "1/min", 9.2e4),
    Quantity("E", "K", 4000.0),
    Quantity("heat", "K.L/mol", 120.0),
    Quantity("UA", "1/min", 2.09),
    Quantity("feed_price", "1", 0.1),
    Quantity("pump_price", "1", 0.004),
    Quantity("cooling_price", "1", 0.01),
    Quantity("fixed_cost", "1", 50.0),
)


def _ode(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """Rates of concentration and temperature per minute."""
    cA, T = ca.vertsplit(x)
    q, Tc = ca.vertsplit(u)
    cAf, Tf = ca.vertsplit(d)
    parameter = by_name(PARAMETERS, p)
    V = parameter["V"]
    k0 = parameter["k0"]
    E = parameter["E"]
    heat = parameter["heat"]
    UA = parameter["UA"]

    # Arrhenius' law, first order in A.
    rate = k0 * ca.exp(-E / T) * cA
    # Balance of A: the feed brings it, the product takes it, the reaction consumes it.
    fed = q / V * (cAf - cA)
    consumed = rate
    # Balance of heat, over the heat capacity of the content: each term is in K/min.
    heated_by_feed = q / V * (Tf - T)
    heated_by_reaction = heat * rate
    heated_by_jacket = UA * (Tc - T)
    return ca.vertcat(
        fed - consumed,
        heated_by_feed + heated_by_reaction + heated_by_jacket,
    )


def _economic_cost(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """Feed, pumping and cooling less the product, per minute."""
    cA = x[0]
    q, Tc = ca.vertsplit(u)
    cAf, Tf = ca.vertsplit(d)
    parameter = by_name(PARAMETERS, p)
    fixed_cost = parameter["fixed_cost"]
    feed_price = parameter["feed_price"]
    pump_price = parameter["pump_price"]
    cooling_price = parameter["cooling_price"]
    feed = feed_price * q * cAf
    # The product's price is the unit of the cost.
    product = q * (cAf - cA)
    pumping = pump_price * q**2
    cooling = cooling_price * (Tf - Tc) ** 2
    return fixed_cost + feed - product + (pumping + cooling)


def model() -> Model:
    """An exothermic reaction A → B in a stirred tank with a cooling jacket; time in minutes."""
    return Model(
        name="reactor",
        # In the economic tuning one unit of each state and action weighs the same.
        states=(
            Quantity("cA", "mol/L", 0.5, deviation=1.0),
            Quantity("T", "K", 345.0, deviation=1.0),
        ),
        actions=(
            Quantity("q", "L/min", 100.0, deviation=1.0),
            Quantity("Tc", "K", 320.0, deviation=1.0),
        ),
        disturbances=(
            Quantity("cAf", "mol/L", 1.0),
            # Counted from 0 °C, as the evaporator's temperatures are.
            Quantity("Tf", "K", 350.0, magnitude=76.85),
        ),
        parameters=PARAMETERS,
        ode=_ode,
        economic_cost=_economic_cost,
        time_unit=60.0,
        uncertain=("UA",),  # the jacket fouls
    )
