"""Samples of a closed loop, taken when told to: a program that runs on this version and on others.

It asks only for what all versions have. The first line of standard input is the scenario; each line
after it `KIND COUNT`, answered by the CPU seconds of that many samples.
"""

import os
import sys
from time import process_time

import numpy as np

DEVIATION = 3.0


def compiled(controller):
    """The controller with its functions compiled, by this version or an old one."""
    if hasattr(controller, "compilation"):
        controller.compilation.finish()
    else:
        controller.compile()
    return controller


class Loop:
    """A controller in its loop with the plant."""

    def __init__(self, scenario):
        from controllers.factories import tuned
        from cosim import FmuPlant

        self.plant = FmuPlant(scenario)
        self.controller = compiled(tuned(self.plant.scenario))
        self.noise = np.random.default_rng(0)
        self.s = self.plant.reset(0)
        lower, upper = self.plant.scenario.action_lower, self.plant.scenario.action_upper
        self.saturate = lambda a: np.minimum(np.maximum(a, lower), upper)

    def evaluate(self, count):
        """What `evaluate` does for a controller and a seed."""
        from cosim import simulate

        simulate(self.plant, self.controller, count, 0, residuals=False)

    def value(self, count):
        """V and its gradient, no plant."""
        for _ in range(count):
            self.controller.prepare()
            self.controller.feedback(self.s).value_gradient  # noqa: B018

    def q_learning(self, count):
        """V(s), then Q(s, a) and dQ/dθ of an explored action, then the plant."""
        for e in DEVIATION * self.noise.standard_normal((count, 2)):
            self.controller.prepare()
            solution = self.controller.feedback(self.s)
            a = self.saturate(solution.action + e)
            explored = self.controller.feedback(self.s, a)
            explored.value_gradient  # noqa: B018
            self.s = self.plant.step(a).s

    def actor_critic(self, count):
        """π(s), V(s), dV/dθ and dπ/dθ, then the plant."""
        for e in DEVIATION * self.noise.standard_normal((count, 2)):
            self.controller.prepare()
            solution = self.controller.feedback(self.s)
            solution.value_gradient  # noqa: B018
            solution.policy_jacobian  # noqa: B018
            self.s = self.plant.step(self.saturate(solution.action + e)).s


def main():
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)  # an FMU is native code that may print
        lines = iter(sys.stdin)
        loop = Loop(next(lines).strip())
        for line in lines:
            kind, count = line.split()
            loop.s = loop.plant.reset(0)
            loop.controller.reset()
            begin = process_time()
            getattr(loop, kind)(int(count))
            print(process_time() - begin, file=answers, flush=True)


if __name__ == "__main__":
    main()
