"""The controller's model of the unstable reactor: mass and heat balances, nominal feed."""

from __future__ import annotations

import casadi as ca

from controllers.model import Model, Quantity, by_name

PARAMETERS = (
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
)


def _ode(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """Rates of concentration, temperature and jacket temperature per minute."""
    cA, T, Tj = ca.vertsplit(x)
    q, Tc = ca.vertsplit(u)
    cAf, Tf = ca.vertsplit(d)
    parameter = by_name(PARAMETERS, p)
    V = parameter["V"]
    k0 = parameter["k0"]
    E = parameter["E"]
    heat = parameter["heat"]
    diffusion = parameter["diffusion"]
    UA = parameter["UA"]
    coolant = parameter["coolant"]
    jacket = parameter["jacket"]

    # Arrhenius' law, first order in A; what is hot enough waits for the diffusion of A.
    k = k0 * ca.exp(-E / T)
    rate = k * diffusion / (k + diffusion) * cA
    # Balance of A: the feed brings it, the product takes it, the reaction consumes it.
    fed = q / V * (cAf - cA)
    consumed = rate
    # Balances of heat, over the heat capacity of content or jacket: each term is in K/min.
    heated_by_feed = q / V * (Tf - T)
    heated_by_reaction = heat * rate
    heated_by_jacket = UA * (Tj - T)
    jacket_by_coolant = coolant * (Tc - Tj)
    jacket_by_reactor = jacket * (T - Tj)
    return ca.vertcat(
        fed - consumed,
        heated_by_feed + heated_by_reaction + heated_by_jacket,
        jacket_by_coolant + jacket_by_reactor,
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
    """An exothermic reaction A → B at an unstable steady state; time in minutes."""
    return Model(
        name="unstable reactor",
        # In the economic tuning one unit of each state and action weighs the same.
        states=(
            Quantity("cA", "mol/L", 0.35, deviation=1.0),
            Quantity("T", "K", 350.0, deviation=1.0),
            Quantity("Tj", "K", 315.0, deviation=1.0),
        ),
        actions=(
            Quantity("q", "L/min", 50.0, deviation=1.0),
            Quantity("Tc", "K", 290.0, deviation=1.0),
        ),
        disturbances=(
            Quantity("cAf", "mol/L", 1.0),
            # Counted from the temperature of the surroundings, 300 K.
            Quantity("Tf", "K", 350.0, magnitude=50.0),
        ),
        parameters=PARAMETERS,
        ode=_ode,
        economic_cost=_economic_cost,
        time_unit=60.0,
        uncertain=("UA",),  # the jacket fouls
    )
