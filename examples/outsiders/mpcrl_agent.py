"""Train an mpcrl agent (second-order LSTD Q-learning on an NMPC solved by IPOPT) and store its θ.

    pip install 'rti-cosim[outsiders]'
    python examples/outsiders/mpcrl_agent.py --steps 3000 --seed 0

The NMPC is the naive one in mpcrl's own terms (mpcrl_nmpc.py beside this file); what it learns, the
model's offset, the lower bound of the predicted states, the stage cost's gradient and the value's
offset, are blocks of the benchmark's θ. So the result is a parameters file, and it is evaluated by
`cosim evaluate --controllers naive,mpcrl=examples/outsiders/mpcrl.toml`.
Budget of the stored result: 3000 plant samples.
"""

import argparse
from pathlib import Path

import gymnasium
import numpy as np
from mpcrl.core.exploration import EpsilonGreedyExploration
from mpcrl_nmpc import naive_start, q_learning_agent

import cosim.environment  # noqa: F401 (registers the environment)
from controllers import Parameters, Problem
from cosim import Scenario


class Costs(gymnasium.Wrapper):
    """mpcrl minimises what the environment returns."""

    def step(self, action):
        s, reward, *rest = self.env.step(np.asarray(action, float).ravel())
        return s, -reward, *rest


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("mpcrl.toml"))
    arguments = parser.parse_args()
    scenario = Scenario.load(arguments.scenario)
    problem = Problem.from_scenario(scenario)
    agent = q_learning_agent(
        problem,
        exploration=EpsilonGreedyExploration(
            epsilon=0.3, strength=10.0, mode="additive", seed=arguments.seed
        ),
    )
    env = gymnasium.make("cosim/Evaporator-v0", scenario=scenario)
    env = Costs(gymnasium.wrappers.TimeLimit(env.unwrapped, arguments.steps))
    agent.train(env=env, episodes=1, seed=arguments.seed, raises=False)
    values = agent.learnable_parameters.value_as_dict
    learnt = {name: np.ravel(values[name]) for name in naive_start(problem)}
    learnt["c_lambda"] = float(learnt["c_lambda"][0])
    print(learnt)
    Parameters.naive(problem).replace(learnt).save(arguments.out)


if __name__ == "__main__":
    main()
