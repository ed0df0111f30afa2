"""The evaporator as the controller knows it: the physics of the paper, nominal disturbances."""

from __future__ import annotations

import casadi as ca

from controllers.model import Model, Quantity

STATES = (Quantity("X2", "%", 25.0), Quantity("P2", "kPa", 49.74297))
ACTIONS = (Quantity("P100", "kPa", 191.71322), Quantity("F200", "kg/min", 215.88844))
DISTURBANCES = (
    Quantity("X1", "%", 5.0),
    Quantity("F1", "kg/min", 10.0),
    Quantity("T1", "degC", 40.0),
    Quantity("T200", "degC", 25.0),
)
PARAMETERS = (
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


def _flows(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Product flow F2, vapour flow F4, condensate flow F5 and steam flow F100 in kg/min."""
    concentration, pressure = ca.vertsplit(x)
    steam_pressure, coolant_flow = ca.vertsplit(u)
    _, feed, feed_temperature, coolant_temperature = ca.vertsplit(d)
    a, b, c, slope, e, f, g, h, _, _, ua2, cp, latent, latent_steam, circulation = ca.vertsplit(p)
    boiling = a * pressure + b * concentration + c
    condensing = slope * pressure + e
    steam = f * steam_pressure + g
    steam_duty = h * (feed + circulation) * (steam - boiling)
    vapour = (steam_duty - feed * cp * (boiling - feed_temperature)) / latent
    condenser_duty = ua2 * (condensing - coolant_temperature) / (1 + ua2 / (2 * cp * coolant_flow))
    return feed - vapour, vapour, condenser_duty / latent, steam_duty / latent_steam


def _ode(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    product, vapour, condensate, _ = _flows(x, u, d, p)
    holdup, capacity = p[8], p[9]
    return ca.vertcat((d[1] * d[0] - product * x[0]) / holdup, (vapour - condensate) / capacity)


def _economic_cost(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    product, _, _, steam = _flows(x, u, d, p)
    return 10.09 * (product + p[14]) + 600 * steam + 0.6 * u[1]


def model() -> Model:
    """The evaporation process of paper.tex, Simulations; model time in minutes."""
    return Model(
        name="evaporator",
        states=STATES,
        actions=ACTIONS,
        disturbances=DISTURBANCES,
        parameters=PARAMETERS,
        ode=_ode,
        economic_cost=_economic_cost,
        time_unit=60.0,
    )
