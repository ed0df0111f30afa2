"""The controller's model of the evaporator: the paper's physics, nominal disturbances."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import casadi as ca

from controllers.model import Model, Quantity, by_name

# In the economic tuning one unit of each weighs the same, as in the paper.
STATES = (
    Quantity("X2", "%", 25.0, deviation=1.0),
    Quantity("P2", "kPa", 49.74297, deviation=1.0),
)
ACTIONS = (
    Quantity("P100", "kPa", 191.71322, deviation=1.0),
    Quantity("F200", "kg/min", 215.88844, deviation=1.0),
)
DISTURBANCES = (
    Quantity("X1", "%", 5.0),
    Quantity("F1", "kg/min", 10.0),
    Quantity("T1", "degC", 40.0, magnitude=40.0),
    Quantity("T200", "degC", 25.0, magnitude=25.0),
)
PARAMETER_VALUES = (
    Quantity("a", "degC/kPa", 0.5616),
    Quantity("b", "degC/%", 0.3126),
    Quantity("c", "degC", 48.43),
    Quantity("d", "degC/kPa", 0.507),
    Quantity("e", "degC", 55.0),
    Quantity("f", "degC/kPa", 0.1538),
    Quantity("g", "degC", 90.0),
    Quantity("h", "kW.min/(kg.degC)", 0.16),
    Quantity("M", "kg", 20.0),
    Quantity("C", "kg/kPa", 4.0),
    Quantity("UA2", "kW/degC", 6.84),
    Quantity("Cp", "kW.min/(kg.degC)", 0.07),
    Quantity("lambda_", "kW.min/kg", 38.5),
    Quantity("lambda_s", "kW.min/kg", 36.6),
    Quantity("F3", "kg/min", 50.0),
)


class Flows(NamedTuple):
    """Product, vapour, condensate and steam in kg/min."""

    F2: ca.SX
    F4: ca.SX
    F5: ca.SX
    F100: ca.SX


def _flows(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> Flows:
    """The flows of paper.tex, Simulations, at a state, action, disturbance w and parameters p."""
    X2, P2 = ca.vertsplit(x)
    P100, F200 = ca.vertsplit(u)
    disturbance = by_name(DISTURBANCES, w)
    F1 = disturbance["F1"]
    T1 = disturbance["T1"]
    T200 = disturbance["T200"]
    parameter = by_name(PARAMETER_VALUES, p)
    a = parameter["a"]
    b = parameter["b"]
    c = parameter["c"]
    d = parameter["d"]
    e = parameter["e"]
    f = parameter["f"]
    g = parameter["g"]
    h = parameter["h"]
    UA2 = parameter["UA2"]
    Cp = parameter["Cp"]
    lambda_ = parameter["lambda_"]
    lambda_s = parameter["lambda_s"]
    F3 = parameter["F3"]

    # Temperatures in °C: the liquid boils at its pressure and concentration, vapour and steam
    # condense at their pressures.
    T2 = a * P2 + b * X2 + c
    T3 = d * P2 + e
    T100 = f * P100 + g

    # Heat from the steam in kW. Feed and recirculation pass the heater: both improve its transfer.
    UA1 = h * (F1 + F3)
    Q100 = UA1 * (T100 - T2)

    # Heat to the cooling water in kW, driven by the mean temperature of the water: its heat balance
    # eliminates the temperature at which it leaves.
    warming_of_water = 1 + UA2 / (2 * Cp * F200)
    Q200 = UA2 * (T3 - T200) / warming_of_water

    # Heat balance of the liquid: what does not warm the feed up evaporates water.
    warming_of_feed = F1 * Cp * (T2 - T1)
    F4 = (Q100 - warming_of_feed) / lambda_
    # The level is held: what does not evaporate is drawn off.
    F2 = F1 - F4
    F5 = Q200 / lambda_
    F100 = Q100 / lambda_s
    return Flows(F2, F4, F5, F100)


def _ode(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> ca.SX:
    """Rates of X2 and P2: M X2' = F1 X1 − F2 X2 and C P2' = F4 − F5."""
    X2 = x[0]
    disturbance = by_name(DISTURBANCES, w)
    X1 = disturbance["X1"]
    F1 = disturbance["F1"]
    parameter = by_name(PARAMETER_VALUES, p)
    M = parameter["M"]
    C = parameter["C"]
    flows = _flows(x, u, w, p)

    # Solute: what the feed brings less what the product takes away.
    solute_in = F1 * X1
    solute_out = flows.F2 * X2
    solute = solute_in - solute_out
    # Vapour: what evaporates less what condenses.
    vapour = flows.F4 - flows.F5
    return ca.vertcat(solute / M, vapour / C)


def _economic_cost(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> ca.SX:
    """Cost 10.09 (F2 + F3) + 600 F100 + 0.6 F200 per minute: pumping, steam, cooling water."""
    F200 = u[1]
    F3 = by_name(PARAMETER_VALUES, p)["F3"]
    flows = _flows(x, u, w, p)
    pumping = 10.09 * (flows.F2 + F3)
    steam = 600 * flows.F100
    cooling_water = 0.6 * F200
    return pumping + steam + cooling_water


STEAM_PRICE = Quantity("steam_price", "min/kg", 600.0)
"""Cost of a kg of steam."""


def _priced_ode(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> ca.SX:
    """`_ode`, which the last parameter, the price, has no part in."""
    return _ode(x, u, w, p[:-1])


def _priced_cost(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> ca.SX:
    """`_economic_cost` where the last parameter is the price of steam."""
    physical = p[:-1]
    price = p[-1]
    steam = _flows(x, u, w, physical).F100
    cost_at_nominal_price = _economic_cost(x, u, w, physical)
    # The nominal price is in that cost already.
    surcharge = price - STEAM_PRICE.nominal
    return cost_at_nominal_price + surcharge * steam


def priced_model() -> Model:
    """`model` with a parameter more, the price of steam in its economic cost."""
    return replace(
        model(),
        parameters=(*PARAMETER_VALUES, STEAM_PRICE),
        ode=_priced_ode,
        economic_cost=_priced_cost,
    )


def model() -> Model:
    """The evaporation process of paper.tex, Simulations; model time in minutes."""
    return Model(
        name="evaporator",
        states=STATES,
        actions=ACTIONS,
        disturbances=DISTURBANCES,
        parameters=PARAMETER_VALUES,
        ode=_ode,
        economic_cost=_economic_cost,
        time_unit=60.0,
        uncertain=("UA2",),  # the condenser fouls
    )
