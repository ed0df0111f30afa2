"""Learn a neural policy on the evaporator with PPO of Stable-Baselines3.

    pip install 'rti-cosim[outsiders]'
    python examples/gymnasium/proximal_policy.py --steps 20000 --seed 0

The settings are the library's but for the discount and a small first deviation of the actions: an
action moves the plant over its whole range. Prints J of 500 held-out samples at each stage.
"""

import argparse

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO

import cosim.environment  # noqa: F401 (registers the environments)

HELD_OUT = 1_000_000


def mean_cost(model, env, steps=500):
    """J of the greedy policy on held-out disturbances."""
    s, _ = env.reset(seed=HELD_OUT)
    total = 0.0
    for _ in range(steps):
        s, _, _, _, info = env.step(model.predict(s, deterministic=True)[0])
        total += info["stage_cost"] + info["penalty"]
    return total / steps


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenario", default="paper")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # the networks are too small to share
    name = "cosim/EvaporatorNormalised-v0"
    env = gymnasium.make(name, scenario=arguments.scenario)
    judge = gymnasium.make(name, scenario=arguments.scenario)
    model = PPO(
        "MlpPolicy",
        env,
        gamma=0.99,
        seed=arguments.seed,
        device="cpu",
        policy_kwargs={"net_arch": [64, 64], "log_std_init": float(np.log(0.1))},
    )
    print(f"{0:7d} plant samples   J {mean_cost(model, judge):10.1f}")
    part = max(arguments.steps // 4, 2048)
    for done in range(part, arguments.steps + 1, part):
        model.learn(part, reset_num_timesteps=False)
        print(f"{done:7d} plant samples   J {mean_cost(model, judge):10.1f}")


if __name__ == "__main__":
    main()
