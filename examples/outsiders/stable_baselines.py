"""Train SAC or PPO of Stable-Baselines3 on the benchmark's environment and export the actor.

    pip install 'rti-cosim[outsiders]'
    python examples/outsiders/stable_baselines.py sac --steps 30000 --seed 0

The budgets behind the stored results: SAC 30 000 plant samples, PPO 200 000. The reward is shifted
and scaled, which changes no optimum; everything else is the library's default but for the discount,
which is the scenario's, and a network of two layers of 64.
"""

import argparse
from pathlib import Path

import gymnasium
import numpy as np
import torch
from policy import action, observation
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.utils import set_random_seed

import cosim.environment  # noqa: F401 (registers the environment)
from cosim import Scenario

COST_SCALE = 1000.0


class Normalised(gymnasium.Wrapper):
    """Deviations from the operating point for the agent, physical units for the plant."""

    def __init__(self, env, scenario):
        super().__init__(env)
        self._scenario = scenario
        box = gymnasium.spaces.Box
        self.observation_space = box(-np.inf, np.inf, (len(scenario.plant.states),), np.float64)
        self.action_space = box(-1.0, 1.0, (len(scenario.plant.actions),), np.float32)

    def reset(self, **options):
        s, info = self.env.reset(**options)
        return observation(self._scenario, s), info

    def step(self, normalised):
        s, reward, *rest = self.env.step(action(self._scenario, np.asarray(normalised, float)))
        cost = -reward - self._scenario.controller.reference_cost
        return observation(self._scenario, s), -cost / COST_SCALE, *rest


def export(model, path):
    """Store the actor's layers as plain arrays."""
    policy = model.policy
    if isinstance(model, SAC):
        hidden, head, between, last = policy.actor.latent_pi, policy.actor.mu, "relu", "tanh"
    else:
        hidden, head = policy.mlp_extractor.policy_net, policy.action_net
        between, last = "tanh", "none"
    layers = [layer for layer in (*hidden, head) if hasattr(layer, "weight")]
    arrays = {}
    for i, layer in enumerate(layers):
        arrays[f"W{i}"] = layer.weight.detach().numpy().astype(float)
        arrays[f"b{i}"] = layer.bias.detach().numpy().astype(float)
    np.savez(path, layers=len(layers), between=between, last=last, **arrays)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("algorithm", choices=["sac", "ppo"])
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent)
    arguments = parser.parse_args()
    set_random_seed(arguments.seed)
    torch.set_num_threads(1)  # the networks are too small to share, and sums keep their order
    scenario = Scenario.load(arguments.scenario)
    env = Normalised(gymnasium.make("cosim/Evaporator-v0", scenario=scenario), scenario)
    settings = {"gamma": scenario.discount, "seed": arguments.seed, "device": "cpu", "verbose": 1}
    settings["policy_kwargs"] = {"net_arch": [64, 64]}
    model = {"sac": SAC, "ppo": PPO}[arguments.algorithm]("MlpPolicy", env, **settings)
    model.learn(arguments.steps)
    export(model, arguments.out / f"{arguments.algorithm}.npz")


if __name__ == "__main__":
    main()
