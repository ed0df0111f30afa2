"""A second plant: the reactor's model for the controller, and a run. `python cstr.py`"""

from pathlib import Path

import casadi as ca

from controllers import Model, Quantity
from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate
from fmus.own import build_folder

HERE = Path(__file__).parent


def model():
    """Two mole balances, in minutes; the economic optimum is q = 12, cA = cB = 0.5, cost -6."""

    def ode(x, u, d, p):
        rate = u[0] / 10.0
        return ca.vertcat(rate * (d[0] - x[0]) - 1.2 * x[0], 1.2 * x[0] - rate * x[1])

    return Model(
        name="cstr",
        states=(Quantity("cA", "mol/L", 0.5), Quantity("cB", "mol/L", 0.5)),
        actions=(Quantity("q", "L/min", 12.0),),
        disturbances=(Quantity("cAf", "mol/L", 1.0),),
        parameters=(),
        ode=ode,
        economic_cost=lambda x, u, d, p: u[0] / 2 - 2 * u[0] * x[1],
        time_unit=60.0,
    )


if __name__ == "__main__":
    build_folder(HERE, HERE / "cstr.fmu")
    scenario = Scenario.load(HERE / "cstr.toml")
    with FmuPlant(scenario) as plant:
        print(simulate(plant, naive(scenario), steps=500, seed=0).summary())
