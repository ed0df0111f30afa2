"""Regenerate tests/controllers/data/qps.npz: QPs from closed-loop runs of scenario `paper`.

Run `python -m benchmarks.record_qps`. Naive, tuned-like, greedy and learned-like
θ, explored and with either Hessian, start on the constraint, far above it and far below it; every
third sample is kept, as V and as Q in turns.
"""

from __future__ import annotations

import numpy as np

from controllers import Parameters, RtiNmpc
from cosim import FmuPlant
from tests.helpers.sampling import evaporator_problem, random_action, random_parameters
from tests.helpers.stored import PATH, StoredQp, blocks, write

SAMPLES, EVERY = 90, 3


def parameters() -> dict[str, Parameters]:
    """θ by name; tuned-like and greedy have the economic gradient and light action weights."""
    problem = evaporator_problem()
    naive = Parameters.naive(problem, blocks())
    tuned = naive.replace(
        {
            "B_l": np.diag([0.9, 0.05, 0.006, 0.002]),
            "b_l": [60.29, 0, 0, 0],
            "B_Vf": np.diag([5.0, 0.5]),
        }
    )
    # The coolant is worth so much that it goes to its bound, where the state then leaves its own.
    greedy = tuned.replace({"B_l": np.diag([0.9, 0.05, 0.01, 5e-4]), "b_l": [60.29, 0, -4, -0.25]})
    learned = random_parameters(problem, blocks(), np.random.default_rng(7)).replace(
        {
            "x_l": [26.2, 40.3],
            "x_u": [99.0, 79.0],
            "c_f": [0.05, -0.1],
            "w_sigma": [70, 300],
            "W_sigma": [800, 0.3],
        }
    )
    return {"naive": naive, "tuned-like": tuned, "greedy": greedy, "learned-like": learned}


def main() -> None:
    """Run, pick and store."""
    problem, named = evaporator_problem(), parameters()
    starts = ([25.0, 49.743], [45.0, 70.0], [18.0, 44.0])
    plan = [
        (hessian, theta, start)
        for hessian in ("gauss-newton", "exact")
        for theta in named.values()
        for start in (starts if hessian == "gauss-newton" else starts[1:2])
    ]
    runs, samples = [(hessian, theta) for hessian, theta, _ in plan], []
    with FmuPlant("paper") as plant:
        for run, (hessian, theta, start) in enumerate(plan):
            rng = np.random.default_rng(run)
            controller = RtiNmpc(problem, theta, hessian=hessian)
            s = plant.reset(run, start)
            for k in range(SAMPLES):
                controller.prepare()
                point = controller.linearisation_point
                explored = random_action(problem, rng) if rng.random() < 0.2 else None
                solution = controller.feedback(s)
                action = solution.action if explored is None else explored
                enforced = action if k // EVERY % 2 else None
                if k % EVERY == 0:
                    samples.append((run, StoredQp(hessian, theta, s.copy(), enforced, point)))
                if enforced is not None:
                    controller.feedback(s, enforced)
                s = plant.step(np.clip(action, problem.action_lower, problem.action_upper)).s
    write(runs, samples)
    print(f"{len(samples)} QPs of {len(runs)} runs in {PATH}: {PATH.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
