"""What a gradient along rollouts of the empirical model adds to `model-based`.

    python -m benchmarks.pathwise holdup cautious 11 --samples 1440 --parameters M UA2

After so many samples of operation all of θ follows dJ/dθ. J is the model's mean cost with its
expected penalties. The gradient is exact but for what the linearisation point owes to θ. With
X = ds/dθ, from zero, and the QP's own dπ/ds and dπ/dθ, U = da/dθ = dπ/ds X + dπ/dθ and
X₊ = F_s X + F_a U. Steps are p = −(M + λ)⁻¹ dJ/dθ, M the mean of dπ/dθᵀ R dπ/dθ, for several λ and
lengths √(pᵀMp); the model chooses among them on new noise. `--without gradient` has a random vector
in its place, all else the same. Greedy J is that of five held-out runs of 1000 samples, after 300.
Development seeds are 11 to 19.
"""

from __future__ import annotations

import numpy as np

from benchmarks.model_based import asked, greedy
from controllers import compile_functions
from controllers.factories import nmpc, optimal
from cosim.plant import FmuPlant
from learning.model_based import BackOffOnModel, ModelBased
from learning.step import clip_eigenvalues, smallest_eigenvalue
from learning.training_run import begin

ROUNDS, SAMPLES = 12, 3300
DAMPINGS = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
"""λ as shares of M's largest eigenvalue."""
RADIUS, LENGTHS = 0.02, (4.0, 1.0, 0.25)
"""First length of a step, as a share of the actions' range, and those tried, in the present one."""
STEP = 1e-4
"""Of central differences, in the units of (s, a)."""


def gradient(problem, controller, inputs, model, costs, picks, burn_in):
    """dJ/dθ (n_θ,) and M (n_θ, n_θ) at the controller's θ, along its rollout's inputs (s, a).

    `costs` are the model's `ExpectedCosts`; the first `burn_in` samples do not count.
    """
    n, count, jacobians = problem.n_states, len(inputs), []
    controller.reset()
    for row in inputs:
        controller.prepare()
        solution = controller.feedback(row[:n])
        jacobians.append((solution.policy_state_jacobian, solution.policy_jacobian))
    F, cost = np.empty((count, n, inputs.shape[1])), np.empty(inputs.shape)
    for j, unit in enumerate([*problem.units.state, *problem.units.action]):
        ends = []
        for sign in (1, -1):
            predicted, h, _ = model.predict(inputs + sign * STEP * unit * np.eye(len(cost.T))[j])
            after = (predicted + h * model.residuals[picks])[:, :n]
            ends.append((after, costs(predicted, h)[0]))
        F[:, :, j], cost[:, j] = ((a - b) / (2 * STEP * unit) for a, b in zip(*ends, strict=True))
    R = np.diag((problem.action_upper - problem.action_lower) ** -2.0)
    X, slope, metric = np.zeros((n, controller.theta.size)), 0.0, 0.0
    for k, (by_state, by_theta) in enumerate(jacobians):
        U = by_state @ X + by_theta
        if k >= burn_in:
            slope = slope + cost[k, :n] @ X + cost[k, n:] @ U
            metric = metric + by_theta.T @ R @ by_theta
        X = F[k, :, :n] @ X + F[k, :, n:] @ U
    return slope / (count - burn_in), metric / (count - burn_in)


def descend(problem, controller, search, rollout, model, start, theta, rng, without, settings):
    """θ after `ROUNDS` of steps that by the model pay."""
    radius = RADIUS
    least = 0.5 * smallest_eigenvalue(controller.parameters.blocks, theta)
    for number in range(ROUNDS):
        picks = rng.integers(len(model.residuals), size=SAMPLES, dtype=np.int32)
        ((inputs, _, _),) = rollout([theta], start, model, picks)
        controller.theta = theta
        slope, metric = gradient(
            problem, controller, inputs, model, search._costs, picks, settings.burn_in
        )
        w, V = np.linalg.eigh(metric)
        if without == "gradient":
            slope = V @ (np.sqrt(np.maximum(w, 0.0)) * rng.normal(size=w.size))
        thetas, lengths = [theta], [radius / 16]
        for damping in DAMPINGS:
            p = -V @ ((V.T @ slope) / (w + damping * w[-1]))
            for length in (radius * share for share in LENGTHS):
                step = p * length / np.sqrt(p @ metric @ p)
                thetas.append(clip_eigenvalues(controller.parameters.blocks, theta + step, least))
                lengths.append(length)
        search.draw(settings.fine_rollout)
        costs = [predicted.cost for predicted in search.predicted_costs(thetas)]
        best = int(np.argmin(costs))
        print(f"round {number + 1:2d}: the model predicts {costs[0]:.2f} -> {costs[best]:.2f}")
        theta, radius = thetas[best], lengths[best]
    return theta


def main() -> None:
    """Operate, descend on the model, and print greedy J before and after."""
    without, run = asked(__doc__, 1440, {"nothing": {}, "gradient": {}})
    scenario = run.scenario
    with FmuPlant(scenario) as plant:
        loop = begin(run, ModelBased, plant)
        compile_functions(loop.controller, run.samples)
        for _ in range(run.samples):
            loop.advance()
        rule, before, rng = loop.algorithm, loop.parameters, np.random.default_rng(1)
    settings = run.configuration
    model, (latest, _) = rule._data.fit(), rule._data.latest(settings.recent_samples)
    problem, controller = rule._problem, nmpc(scenario, before)
    compile_functions(controller)
    search = BackOffOnModel(problem, rule._rollout, before, model, latest, settings, rng)
    start = latest[-1, : problem.n_states]
    loops = search, rule._rollout, model
    after = descend(problem, controller, *loops, start, before.theta, rng, without, settings)
    best = greedy(scenario, optimal(scenario))
    for name, theta in (("model-based", before.theta), ("and the gradient", after)):
        controller.theta = theta
        J = greedy(scenario, controller)
        print(f"{name}: J {J:.2f}, regret {100 * (J / best - 1):.2f} %", flush=True)


if __name__ == "__main__":
    main()
