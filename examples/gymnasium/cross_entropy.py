"""Learn a linear feedback law on the evaporator by the cross-entropy method, in one file.

    python examples/gymnasium/cross_entropy.py --generations 40 --seed 0

Nothing but NumPy and Gymnasium: a candidate is a matrix K and an offset k of a = K·s + k, in the
normalised units of `cosim/EvaporatorNormalised-v0`; a generation's candidates meet the same
disturbances, each in one of the vectorised environments. Prints the plant samples used and J of the
generation's mean law on held-out disturbances.
"""

import argparse

import gymnasium
import numpy as np

POPULATION, ELITE, STEPS = 24, 6, 150
HELD_OUT = 1_000_000


def mean_costs(envs, laws, seeds):
    """J of each law, (population,), over one episode each."""
    s, _ = envs.reset(seed=seeds)
    total = np.zeros(envs.num_envs)
    for _ in range(STEPS):
        actions = np.einsum("pij,pj->pi", laws[:, :, :-1], s) + laws[:, :, -1]
        s, *_, info = envs.step(np.clip(actions, -1.0, 1.0).astype(np.float32))
        total += info["stage_cost"] + info["penalty"]
    return total / STEPS


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--generations", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenario", default="paper")
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    envs = gymnasium.make_vec(
        "cosim.environment:cosim/EvaporatorNormalised-v0",
        num_envs=POPULATION,
        scenario=arguments.scenario,
    )
    n = envs.single_observation_space.shape[0]
    m = envs.single_action_space.shape[0]
    mean, deviation = np.zeros((m, n + 1)), np.full((m, n + 1), 0.5)
    held_out = [HELD_OUT + k for k in range(POPULATION)]
    for generation in range(arguments.generations + 1):
        if generation % 10 == 0:
            cost = mean_costs(envs, np.tile(mean, (POPULATION, 1, 1)), held_out).mean()
            print(f"{generation * POPULATION * STEPS:7d} plant samples   J {cost:10.1f}")
        laws = mean + deviation * rng.standard_normal((POPULATION, m, n + 1))
        elite = laws[np.argsort(mean_costs(envs, laws, [generation] * POPULATION))[:ELITE]]
        mean = elite.mean(axis=0)
        deviation = elite.std(axis=0) + 0.3 * 0.9**generation
    envs.close()
    print("K | k =", np.array2string(mean, precision=3))


if __name__ == "__main__":
    main()
