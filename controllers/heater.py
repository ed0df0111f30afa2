"""The controller's model of the heated tank: content and temperature, no pipe and no dead time."""

from __future__ import annotations

import casadi as ca

from controllers.model import Model, Quantity

CP = 4.18  # kJ/(kg.K), of water


def _ode(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """Rates of content and temperature per minute; the product is as warm as the tank."""
    M, T = ca.vertsplit(x)
    F, Q = ca.vertsplit(u)
    Fin, Tin = ca.vertsplit(d)
    content = Fin - F
    # Heat over the heat capacity of water, in kg·K/min; a kW is 60 kJ a minute.
    from_feed = Fin * (Tin - T)
    from_heater = 60 * Q / CP
    warming = (from_feed + from_heater) / M
    return ca.vertcat(content, warming)


def _economic_cost(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
    """Cost of heating and holding, per minute."""
    heat_price, holding_price = ca.vertsplit(p)
    M = x[0]
    Q = u[1]
    heating = heat_price * Q
    holding = holding_price * M
    return heating + holding


def model() -> Model:
    """A tank that is heated as its content flows through; time in minutes."""
    return Model(
        name="heater",
        states=(
            Quantity("M", "kg", 100.0),
            Quantity("T", "degC", 60.0),
        ),
        actions=(
            Quantity("F", "kg/min", 20.0),
            Quantity("Q", "kW", 55.7),
        ),
        disturbances=(
            Quantity("Fin", "kg/min", 20.0),
            # Counted from 0 °C.
            Quantity("Tin", "degC", 20.0, magnitude=20.0),
        ),
        parameters=(
            Quantity("heat_price", "1/kW", 1.0),
            Quantity("holding_price", "1/kg", 0.1),
        ),
        ode=_ode,
        economic_cost=_economic_cost,
        time_unit=60.0,
    )
