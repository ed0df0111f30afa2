"""Ten random plants with a linear cost, from draft to control: python -m benchmarks.linear_costs

Each plant is a stable linear or bilinear system of 1 to 4 states and 1 or 2 actions, in units that
differ by decades. Its cost is linear, so that the cheapest steady state is at bounds or a saddle;
the reference, the origin, is no optimum. Each is built as an FMU, drafted by `cosim scenario init`,
tuned, and controlled. A row of the table is a plant. Beside J of the controllers stands the cost of
the cheapest steady state, which no disturbance moves and which no J on the noisy plant need reach.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import warnings
from pathlib import Path

import casadi as ca
import numpy as np

from controllers import Model, Problem, Quantity, build_plant
from controllers.economic import tune
from controllers.errors import TuningWarning
from cosim import Scenario, evaluate
from cosim.core.errors import CosimError
from cosim.core.result import markdown_table

PLANTS = 10
BILINEAR = 0.3
"""Size of the products of state and action, in every other plant."""
NOISE = 0.02
"""Half width of what disturbs each state's rate, as a share of the state's upper bound."""
SEEDS, STEPS = 3, 500
CONTROLLERS = ("naive", "tuned", "cautious")
HEADER = (
    "plant", "states, actions", "σ", "a tenth costs", "each active bound costs, a sample",
    "cheapest steady state", *(f"J `{name}`" for name in CONTROLLERS),
    "violating samples of `cautious`", "verdict",
)  # fmt: skip


def sizes_of(rng):
    """Sizes of states (n,) and actions (m,): their bounds are ± these."""
    n = int(rng.integers(1, 5))
    m = int(rng.integers(1, 3))
    sizes = 10.0 ** rng.integers(-2, 3, size=n + m)
    return sizes[:n], sizes[n:]


def plant_of(seed):
    """Model and sizes of a random plant: x' = Gx + Hu + (Bu)·x + d, cost prices·(x, u).

    Args:
        seed: draws sizes, rates and prices; odd ones have products of state and action.
    """
    rng = np.random.default_rng(seed)
    x_size, u_size = sizes_of(rng)
    n, m = len(x_size), len(u_size)
    rates = rng.normal(size=(n, n))
    fastest = np.linalg.eigvals(rates).real.max()
    rates -= (fastest + rng.uniform(0.1, 0.6)) * np.eye(n)
    inputs = rng.normal(size=(n, m))
    prices = rng.normal(size=n + m)
    products = rng.normal(size=(n, m))
    if seed % 2 == 0:
        products = np.zeros((n, m))
    # From variables of size one to their own units.
    rates = rates * x_size[:, None] / x_size
    inputs = inputs * x_size[:, None] / u_size
    products = BILINEAR * products / u_size
    prices = prices / np.concatenate([x_size, u_size])

    def ode(x, u, d, p):
        linear = ca.DM(rates) @ x + ca.DM(inputs) @ u
        return linear + (ca.DM(products) @ u) * x + d

    def cost(x, u, d, p):
        return ca.dot(ca.DM(prices), ca.vertcat(x, u))

    states = []
    disturbances = []
    for i, size in enumerate(x_size):
        states.append(Quantity(f"x{i}", "m", 0.0, magnitude=size))
        disturbances.append(Quantity(f"d{i}", "m/s", 0.0, magnitude=size))
    actions = []
    for i, size in enumerate(u_size):
        actions.append(Quantity(f"u{i}", "m", 0.0, magnitude=size))
    model = Model(
        name=f"linear_cost_{seed}",
        states=tuple(states),
        actions=tuple(actions),
        disturbances=tuple(disturbances),
        parameters=(),
        ode=ode,
        economic_cost=cost,
    )
    return model, x_size, u_size


def __getattr__(name):
    """`benchmarks.linear_costs:plant_3` is the model of seed 3, for a scenario file."""
    word, _, seed = name.partition("_")
    if word != "plant" or not seed.isdigit():
        raise AttributeError(name)
    return lambda: plant_of(int(seed))[0]


def scenario_of(seed, folder):
    """Build the plant's FMU and draft its scenario, as a user would; the scenario."""
    model, x_size, u_size = plant_of(seed)
    limits = {}
    ranges = {}
    for quantity, size in zip((*model.states, *model.actions), (*x_size, *u_size), strict=True):
        limits[quantity.name] = (-size, size)
    for quantity, size in zip(model.disturbances, x_size, strict=True):
        ranges[quantity.name] = NOISE * size
    fmu = folder / f"{model.name}.fmu"
    build_plant(model, fmu, sampling_time=1.0, limits=limits, ranges=ranges)
    target = folder / f"{model.name}.toml"
    draft = [sys.executable, "-m", "cosim", "scenario", "init", str(fmu), "--overwrite"]
    draft += ["--model", f"benchmarks.linear_costs:plant_{seed}", "--out", str(target)]
    done = subprocess.run(draft, check=False, capture_output=True, text=True)
    if done.returncode:
        raise CosimError(done.stderr.strip())
    return Scenario.load(target)


def row_of(seed, folder):
    """A row of the table; a plant that is refused says so in its last cell.

    Args:
        seed: the plant.
        folder: where its FMU and scenario are written.
    """
    _, x_size, u_size = plant_of(seed)
    kind = "bilinear" if seed % 2 else "linear"
    row = [f"{seed}, {kind}", f"{len(x_size)}, {len(u_size)}"]
    try:
        scenario = scenario_of(seed, folder)
        result = tune(Problem.from_scenario(scenario))
        table = evaluate(scenario, CONTROLLERS, SEEDS, STEPS)
    except CosimError as error:
        return [*row, *[""] * (len(HEADER) - 3), f"refused: {error}"]
    addition = result.addition
    # The cost is as convex as the tuning needs.
    sigma = "none"
    tenth = ""
    if addition is not None:
        sigma = f"{addition.size:.3g}"
        tenth = f"{addition.cost_of_a_tenth:.3g}"
    prices = "; ".join(result.steady_state.prices()).replace(", each sample", "")
    if addition is not None and addition.released:
        prices += f" (set-point: {', '.join(addition.released)})"
    frame = table.to_pandas()
    J = frame.groupby("controller")["J"].mean()
    share = frame.groupby("controller")["violating_share"].mean()["cautious"]
    verdict = "controlled" if J["cautious"] < J["naive"] else "no gain on `naive`"
    costs = [f"{J[name]:.3g}" for name in CONTROLLERS]
    steady = f"{result.steady_state.cost:.3g}"
    return [*row, sigma, tenth, prices or "none", steady, *costs, f"{100 * share:.1f} %", verdict]


def main() -> None:
    """Print the table, and how many were refused."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder of FMUs and scenarios")
    parser.add_argument("--plants", type=int, default=PLANTS)
    chosen = parser.parse_args()
    chosen.out.mkdir(parents=True, exist_ok=True)
    # The table says what was added.
    warnings.simplefilter("ignore", TuningWarning)
    rows = []
    for seed in range(chosen.plants):
        rows.append(row_of(seed, chosen.out))
        print(*rows[-1], sep=" | ", file=sys.stderr, flush=True)
    refused = sum(row[-1].startswith("refused") for row in rows)
    table = markdown_table(HEADER, rows).strip()
    print(f"{table}\n\n{refused} of {len(rows)} refused")


if __name__ == "__main__":
    main()
