"""Four tanks, two pumps: as little pumping as keeps the lower levels. `python quadruple_tank.py`"""

from pathlib import Path

import casadi as ca

from controllers import Model, Quantity
from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate
from fmus.plant import Signal, build_plant, plant_model

HERE = Path(__file__).parent
AREA = {"A1": 28.0, "A2": 32.0, "A3": 28.0, "A4": 32.0}  # cm2
HOLE = {"a1": 0.071, "a2": 0.057, "a3": 0.071, "a4": 0.057}  # cm2
PUMP = {"k1": 3.33, "k2": 3.35}  # cm3/(V s)
SPLIT = {"split1": 0.70, "split2": 0.60}  # shares of a pump that go to the lower tank
START = {"h1": 10.0, "h2": 10.0, "h3": 2.0, "h4": 2.0}
LEVELS = tuple(START)


def table():
    """The FMU's variables."""
    return plant_model(
        "quadruple_tank",
        description="Quadruple tank with water drawn at random from the lower tanks",
        states=[Signal(h, "cm", START[h], 0.0, 50.0, f"level of tank {h[1]}") for h in LEVELS],
        inputs=[Signal(v, "V", 3.0, 0.0, 10.0, f"voltage of pump {v[1]}") for v in ("v1", "v2")],
        disturbances=[Signal(d, "cm3/s", 3.0, -20.0, 20.0, f"water drawn from tank {d[1]}", 3.0)
                      for d in ("d1", "d2")],
        outputs=[Signal("cost", "V2", 20.0, 0.0, 200.0, "pumping v1² + v2²")],
        parameters=[
            *(Signal(n, "cm2", x, 1.0, 1e3, f"area of tank {n[1]}") for n, x in AREA.items()),
            *(Signal(n, "cm2", x, 1e-3, 1.0, f"hole of tank {n[1]}") for n, x in HOLE.items()),
            *(Signal(n, "cm3/(V.s)", x, 0.0, 20.0, f"pump {n[1]}'s flow") for n, x in PUMP.items()),
            *(Signal(n, "1", x, 0.0, 1.0, f"share of pump {n[-1]} into the lower tank")
              for n, x in SPLIT.items()),
        ],
        sampling_time=5.0,
    )  # fmt: skip


def model():
    """The controller's own model, in seconds."""
    names = {**AREA, **HOLE, **PUMP, **SPLIT}

    def ode(x, u, d, p):
        q = dict(zip(names, ca.vertsplit(p), strict=True))
        out = [q[f"a{i + 1}"] * ca.sqrt(2 * 981.0 * ca.fmax(x[i], 1e-3)) for i in range(4)]
        pump = [q["k1"] * u[0], q["k2"] * u[1]]
        return ca.vertcat(
            (out[2] + q["split1"] * pump[0] - out[0] - d[0]) / q["A1"],
            (out[3] + q["split2"] * pump[1] - out[1] - d[1]) / q["A2"],
            ((1 - q["split2"]) * pump[1] - out[2]) / q["A3"],
            ((1 - q["split1"]) * pump[0] - out[3]) / q["A4"],
        )

    return Model(
        name="quadruple_tank",
        states=tuple(Quantity(h, "cm", 10.0) for h in LEVELS),
        actions=(Quantity("v1", "V", 3.0), Quantity("v2", "V", 3.0)),
        disturbances=(Quantity("d1", "cm3/s", 3.0), Quantity("d2", "cm3/s", 3.0)),
        parameters=tuple(Quantity(name, "", value) for name, value in names.items()),
        ode=ode,
        economic_cost=lambda x, u, d, p: u[0] ** 2 + u[1] ** 2,
        time_unit=1.0,
    )


if __name__ == "__main__":
    build_plant(table(), (HERE / "equations.h").read_bytes(), HERE / "quadruple_tank.fmu")
    scenario = Scenario.load(HERE / "quadruple_tank.toml")
    with FmuPlant(scenario) as plant:
        print(simulate(plant, naive(scenario), steps=500, seed=0).summary())
