"""`python -m benchmarks.horizons`: QPs that stay unsolved at far states, and what a stage costs.

The states of the first part are drawn in boxes of what the evaporator can be, far beyond its bounds
and anew at each sample, so that no guess fits: a controller solves them in sequence. The second
part is the least time of a sample with all derivatives, of two horizons in turns.
"""

import sys

import numpy as np

from benchmarks.scaling import walk
from controllers import Parameters, Problem, RtiNmpc, compile_functions
from cosim import Scenario

SAMPLES = 2000
BOXES = {
    "X2 10 to 60, P2 40 to 80": ((10.0, 60.0), (40.0, 80.0)),
    "X2 1 to 99, P2 20 to 120": ((1.0, 99.0), (20.0, 120.0)),
}
HORIZONS = (10, 20, 40, 80)
DOUBLED = (80, 160)
AT_MOST = 2.2
REPETITIONS = 7


def compiled(horizon):
    """The paper's naive controller with a horizon, compiled."""
    scenario = Scenario.load("paper").replace({"controller": {"horizon": horizon}})
    problem = Problem.from_scenario(scenario)
    controller = RtiNmpc(problem, Parameters.naive(problem))
    compile_functions(controller)
    assert controller.functions == "compiled"
    return controller


def count_unsolved(controller, box):
    """Print how many QPs of states in a box stay unsolved, one after the other."""
    rng = np.random.default_rng(0)
    lows, highs = np.transpose(BOXES[box])
    reasons = []
    controller.reset()
    for s in rng.uniform(lows, highs, (SAMPLES, 2)):
        controller.prepare()
        try:
            controller.feedback(s)
        except Exception as error:
            if not getattr(type(error), "is_solver_failure", False):
                raise
            reasons.append(str(error))
    horizon = controller.problem.horizon
    print(f"N = {horizon}, {box}: {len(reasons)} of {SAMPLES} unsolved", *set(reasons), flush=True)
    return len(reasons)


def doubling():
    """Print how many times as long a sample of a doubled horizon takes."""
    controllers = [compiled(horizon) for horizon in DOUBLED]
    least = [np.inf] * len(DOUBLED)
    for _ in range(REPETITIONS):
        for i, controller in enumerate(controllers):
            seconds = sum(walk(controller, 20).values())
            least[i] = min(least[i], seconds)
    ratio = least[1] / least[0]
    met = "met" if ratio <= AT_MOST else "MISSED"
    print(f"a sample at N = {DOUBLED[1]} takes {ratio:.2f} × N = {DOUBLED[0]} (≤ {AT_MOST}: {met})")
    return ratio


def main():
    """Measure both; exit code 1 where a QP of the first box stays unsolved or the bar is missed."""
    unsolved = 0
    for horizon in HORIZONS:
        controller = compiled(horizon)
        near, far = BOXES
        unsolved += count_unsolved(controller, near)
        count_unsolved(controller, far)
    ratio = doubling()
    sys.exit(unsolved > 0 or ratio > AT_MOST)


if __name__ == "__main__":
    main()
