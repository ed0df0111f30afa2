"""The controller's model of the evaporator: the paper's physics, nominal disturbances."""

from __future__ import annotations

import casadi as ca

from controllers.model import Model, Quantity

STATES = (Quantity("X2", "%", 25.0), Quantity("P2", "kPa", 49.74297))
ACTIONS = (Quantity("P100", "kPa", 191.71322), Quantity("F200", "kg/min", 215.88844))
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


def _flows(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
    """Product F2, vapour F4, condensate F5 and steam F100 in kg/min."""
    X2, P2 = ca.vertsplit(x)
    P100, F200 = ca.vertsplit(u)
    _, F1, T1, T200 = ca.vertsplit(w)
    a, b, c, d, e, f, g, h, _, _, UA2, Cp, lambda_, lambda_s, F3 = ca.vertsplit(p)
    # Temperatures of the liquid, of the vapour and of the steam.
    T2 = a * P2 + b * X2 + c
    T3 = d * P2 + e
    T100 = f * P100 + g
    # Duties of the heater and of the condenser.
    UA1 = h * (F1 + F3)
    Q100 = UA1 * (T100 - T2)
    Q200 = UA2 * (T3 - T200) / (1 + UA2 / (2 * Cp * F200))

    F4 = (Q100 - F1 * Cp * (T2 - T1)) / lambda_
    F5 = Q200 / lambda_
    F100 = Q100 / lambda_s
    return F1 - F4, F4, F5, F100


def _ode(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> ca.SX:
    """Rates of X2 and P2: M X2' = F1 X1 − F2 X2 and C P2' = F4 − F5."""
    X2 = x[0]
    X1, F1, _, _ = ca.vertsplit(w)
    M = p[8]
    C = p[9]
    F2, F4, F5, _ = _flows(x, u, w, p)
    return ca.vertcat((F1 * X1 - F2 * X2) / M, (F4 - F5) / C)


def _economic_cost(x: ca.SX, u: ca.SX, w: ca.SX, p: ca.SX) -> ca.SX:
    """Cost 10.09 (F2 + F3) + 600 F100 + 0.6 F200 per minute."""
    F200 = u[1]
    F3 = p[14]
    F2, _, _, F100 = _flows(x, u, w, p)
    return 10.09 * (F2 + F3) + 600 * F100 + 0.6 * F200


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
