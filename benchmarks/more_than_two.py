"""What two and four numbers of θ reach: the starts of results/more-than-two.toml.

`python -m benchmarks.more_than_two holdup --out results/starts` tightens two bounds of the tuned θ
(x_l[0] and x_u[1]), then moves as well the two offsets c_f, then in their place two parameters of
the controller's model (M and UA2), each by Nelder and Mead's method. Every candidate meets the same
noise, in the closed loop of the package's C controller and the plant's model; the study judges what
is written here on the FMU with other noise.
"""

import argparse
import ctypes
import time
from pathlib import Path

import casadi as ca
import numpy as np
from scipy.optimize import minimize

from controllers.dynamic_programming import accurate_substeps
from controllers.export.core import core
from controllers.factories import tuned
from controllers.functions import c_source, library
from controllers.model import discretise, economic_cost
from controllers.problem import PlantProblem
from controllers.theta import Parameters, ThetaBlocks
from cosim import Scenario

BURN_IN = 100
LOST = 1e7
UNSURE = ("M", "UA2")
LOOP = r"""
#include "core.h"
#include "sizes.h"
int plant(const double **arguments, double **results, long long int *iw, double *w, int memory);

double run(const double theta[], const double start[], const double d[], int steps, int settling) {
    CoreState state;
    core_reset(&state);
    double x[N_X], next[N_X + 1], w[PLANT_W + 1], sum = 0.0;
    long long int iw[PLANT_IW + 1];
    memcpy(x, start, sizeof x);
    for (int k = 0; k < steps; k++) {
        if (!all_finite(x, N_X)) return INFINITY;
        core_act(&state, x, 0, theta);
        core_commit(&state);
        const double *arguments[PLANT_ARG] = {x, state.applied, d + k * N_D};
        double *results[PLANT_RES] = {next};
        plant(arguments, results, iw, w, 0);
        if (k >= settling) sum += next[N_X];
        memcpy(x, next, sizeof x);
    }
    return sum / (steps - settling);
}
"""


class Loop:
    """The C controller of a scenario with the plant's own model, on noise drawn once."""

    def __init__(self, scenario, seeds, steps):
        self.scenario = scenario
        self.plant = plant = PlantProblem.from_scenario(scenario)
        problem, self.tuned = plant.problem, tuned(scenario).parameters
        blocks, model = ThetaBlocks.from_problem(problem, model_parameters=UNSURE), problem.model
        own = {block.name: self.tuned[block.name] for block in self.tuned.blocks}
        self.start = Parameters.naive(problem, blocks).replace(own)
        (x, u, d, _), p = model.symbols(), ca.DM(plant.parameters)
        substeps = accurate_substeps(plant, 1e-5)
        step = discretise(model, scenario.sampling_time, substeps)
        cost = economic_cost(model)(x, u, d, p) + problem.symbolic_penalty(x)
        function = ca.Function("plant", [x, u, d], [ca.densify(ca.vertcat(step(x, u, d, p), cost))])
        sizes = {"ARG": function.sz_arg(), "RES": function.sz_res(), "W": function.sz_w()}
        lines = [f"#define PLANT_{name} {size}" for name, size in sizes.items()]
        lines += [f"#define PLANT_IW {function.sz_iw()}", f"#define N_D {d.numel()}", ""]
        sources = dict(core(problem, self.start).sources)
        sources |= {"sizes.h": "\n".join(lines), "loop.c": LOOP, "plant.c": c_source([function])}
        self._run = ctypes.CDLL(str(library(sources, ("loop.c", "plant.c")))).run
        self._run.restype = ctypes.c_double
        noise = plant.law.draw(np.random.default_rng(0), seeds * (BURN_IN + steps))
        self._noise = noise.reshape(seeds, BURN_IN + steps, -1)

    def cost(self, parameters):
        """Mean of economic cost and penalty per sample over all runs."""
        rows = (parameters.theta, self.scenario.initial_state)
        fixed = [np.ascontiguousarray(row) for row in rows]
        total = 0.0
        for noise in self._noise:
            addresses = [ctypes.c_void_p(row.ctypes.data) for row in (*fixed, noise)]
            total += min(self._run(*addresses, len(noise), BURN_IN), LOST)
        return total / len(self._noise)


def adjusted(start, numbers, block=None):
    """θ with x_l[0] raised and x_u[1] lowered by two numbers, a block moved by the others."""
    lower, upper = start["x_l"].copy(), start["x_u"].copy()
    lower[0] += numbers[0]
    upper[1] -= numbers[1]
    moved = {block: start[block] + numbers[2:]} if block else {}
    return start.replace({"x_l": lower, "x_u": upper, **moved})


def simplex(loop, begin, sizes, evaluations, block=None):
    """The least J that Nelder and Mead's method finds: (numbers, J)."""
    corners = np.vstack([begin, begin + np.diag(sizes)])
    found = minimize(
        lambda numbers: loop.cost(adjusted(loop.start, numbers, block)),
        begin,
        method="Nelder-Mead",
        options={"initial_simplex": corners, "maxfev": evaluations, "xatol": 0.02, "fatol": 0.2},
    )
    return found.x, found.fun


def main():
    """Search on one scenario, print what was found, write θ."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--steps", type=int, default=1000, help="samples a seed that count")
    parser.add_argument("--out", type=Path, help="folder of the parameters files")
    options = parser.parse_args()
    scenario, began = Scenario.load(options.scenario), time.process_time()
    loop = Loop(scenario, options.seeds, options.steps)

    def report(name, cost, numbers=()):
        spent = time.process_time() - began
        print(name, f"J {cost:.2f}", *(f"{x:.3f}" for x in numbers), f"{spent:.0f} s", flush=True)

    def write(name, parameters):
        if options.out:
            parameters.save(options.out / f"{name}-{scenario.name}.toml")

    grid = [(lower, upper) for lower in (2.5, 5.0, 7.5) for upper in (0.0, 3.0)]
    best = min(grid, key=lambda numbers: loop.cost(adjusted(loop.start, numbers)))
    two, cost = simplex(loop, np.array(best), np.array([0.7, 1.5]), 40)
    report("two", cost, two)
    write("two", adjusted(loop.tuned, two))
    begin = np.append(two, [0.0, 0.0])
    four, cost = simplex(loop, begin, np.array([0.7, 1.5, 0.3, 0.5]), 70, "c_f")
    report("four, offsets", cost, four)
    write("four-offsets", adjusted(loop.tuned, four, "c_f"))
    four, cost = simplex(loop, begin, np.array([-0.7, 1.5, -3.0, -0.5]), 70, "p")
    report("four, model", cost, four)
    write("four-model", adjusted(loop.start, four, "p"))


if __name__ == "__main__":
    main()
