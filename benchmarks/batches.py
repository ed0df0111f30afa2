"""A row of `RtiNmpc.feedback_batch` beside a sample of the controller, one at a time."""

import numpy as np

from benchmarks.measuring import clock, figure
from controllers.factories import tuned

REPETITIONS = 20


def measure(scenario, steps):
    """π and V, without and with all derivatives, for one θ and for a θ of each row."""
    controller = tuned(scenario)
    controller.compile()
    rng = np.random.default_rng(0)
    reference = controller.problem.reference_state
    states = reference + 0.02 * np.abs(reference) * rng.normal(size=(steps, reference.size))
    # So little apart that each row is prepared and all have the active sets of one θ.
    thetas = controller.theta * (1 + 1e-12 * rng.normal(size=(steps, controller.theta.size)))

    def alone(derivatives):
        for s, theta in zip(states, thetas, strict=True):
            controller.theta = theta
            controller.prepare()
            solution = controller.feedback(s)
            if derivatives:
                solution.value_gradient  # noqa: B018
                solution.policy_jacobian  # noqa: B018

    rows = []
    for derivatives, what in ((False, "π, V"), (True, "π, V and all derivatives")):
        for theta, which in ((controller.theta, "one θ"), (thetas, "a θ a row")):
            batch, single = [], []
            for _ in range(REPETITIONS):
                begin = clock()
                controller.feedback_batch(states, theta, derivatives=derivatives)
                middle = clock()
                alone(derivatives)
                batch.append((middle - begin) / steps)
                single.append((clock() - middle) / steps)
            rows.append(figure(f"{what}, {which}", batch, "one by one, a θ each", single))
    return rows
