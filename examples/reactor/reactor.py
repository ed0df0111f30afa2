"""An exothermic reactor at its temperature limit, whose jacket fouls. `python reactor.py`"""

from pathlib import Path

import casadi as ca

from controllers import Model, Quantity
from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate
from fmus.plant import Signal, build_plant, plant_model

HERE = Path(__file__).parent
CONSTANTS = (
    Signal("V", "L", 100.0, 1.0, 1e4, "volume"),
    Signal("k0", "1/min", 9.2e4, 0.0, 1e14, "rate constant at infinite temperature"),
    Signal("E", "K", 4000.0, 0.0, 1e5, "activation energy over the gas constant"),
    Signal("heat", "K.L/mol", 120.0, 0.0, 1e4, "temperature rise by the reaction of 1 mol/L"),
    Signal("UA", "1/min", 2.09, 0.0, 100.0, "heat transfer of the jacket over the heat capacity"),
    Signal("feed_price", "1", 0.1, 0.0, 10.0, "price of the feed over that of the product"),
    Signal("pump_price", "1", 0.004, 0.0, 10.0, "price of the squared flow"),
    Signal("cooling_price", "1", 0.01, 0.0, 10.0, "price of the squared cooling"),
    Signal("fixed_cost", "1", 50.0, 0.0, 1e3, "cost of the plant as such"),
)


def table():
    """The FMU's variables."""
    return plant_model(
        "reactor",
        description="Exothermic stirred-tank reactor with disturbed feed",
        states=[
            Signal("cA", "mol/L", 0.5, 0.0, 10.0, "concentration of A"),
            Signal("T", "K", 345.0, 200.0, 600.0, "temperature"),
        ],
        inputs=[
            Signal("q", "L/min", 100.0, 0.0, 500.0, "feed flow"),
            Signal("Tc", "K", 320.0, 200.0, 400.0, "temperature of the jacket"),
        ],
        disturbances=[
            Signal("cAf", "mol/L", 1.0, 0.0, 10.0, "concentration of A in the feed", 0.1),
            Signal("Tf", "K", 350.0, 200.0, 500.0, "temperature of the feed", 5.0),
        ],
        outputs=[Signal("cost", "1", 30.0, -1e4, 1e4, "cost of feed and cooling less product")],
        parameters=CONSTANTS,
        sampling_time=12.0,
    )


def model():
    """The controller's own model, in minutes."""

    def ode(x, u, d, p):
        V, k0, E, heat, UA, *_ = ca.vertsplit(p)
        rate = k0 * ca.exp(-E / x[1]) * x[0]
        return ca.vertcat(
            u[0] / V * (d[0] - x[0]) - rate,
            u[0] / V * (d[1] - x[1]) + heat * rate + UA * (u[1] - x[1]),
        )

    def cost(x, u, d, p):
        feed, pump, cooling, fixed = ca.vertsplit(p[5:])
        product = u[0] * (d[0] - x[0])
        quadratic = pump * u[0] ** 2 + cooling * (d[1] - u[1]) ** 2
        return fixed + feed * u[0] * d[0] - product + quadratic

    return Model(
        name="reactor",
        states=(Quantity("cA", "mol/L", 0.5), Quantity("T", "K", 345.0)),
        actions=(Quantity("q", "L/min", 100.0), Quantity("Tc", "K", 320.0)),
        disturbances=(Quantity("cAf", "mol/L", 1.0), Quantity("Tf", "K", 350.0)),
        parameters=tuple(Quantity(c.name, c.unit, c.start) for c in CONSTANTS),
        ode=ode,
        economic_cost=cost,
        time_unit=60.0,
    )


if __name__ == "__main__":
    build_plant(table(), (HERE / "equations.h").read_bytes(), HERE / "reactor.fmu")
    scenario = Scenario.load(HERE / "reactor.toml")
    with FmuPlant(scenario) as plant:
        print(simulate(plant, naive(scenario), steps=500, seed=0).summary())
