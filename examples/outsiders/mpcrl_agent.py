"""Train an mpcrl agent (second-order LSTD Q-learning on an NMPC solved by IPOPT) and store its θ.

    pip install 'rti-cosim[outsiders]'
    python examples/outsiders/mpcrl_agent.py --steps 3000 --seed 0

The NMPC is the benchmark's naive one, written down again in mpcrl's own terms; what it learns, the
model's offset, the lower bound of the predicted states, the stage cost's gradient and the value's
offset, are blocks of the benchmark's θ. So the result is a parameters file, and it is evaluated by
`cosim evaluate --controllers naive,mpcrl=examples/outsiders/mpcrl.toml`.
Budget of the stored result: 3000 plant samples.
"""

import argparse
from pathlib import Path

import casadi as ca
import gymnasium
import numpy as np
from csnlp import Nlp
from csnlp.wrappers import Mpc
from mpcrl import LearnableParameter, LearnableParametersDict, LstdQLearningAgent, UpdateStrategy
from mpcrl.core.exploration import EpsilonGreedyExploration
from mpcrl.optim import NewtonMethod

import cosim.environment  # noqa: F401 (registers the environment)
from controllers import Parameters, Problem
from controllers.model import discretise
from cosim import Scenario


class Costs(gymnasium.Wrapper):
    """mpcrl minimises what the environment returns."""

    def step(self, action):
        s, reward, *rest = self.env.step(np.asarray(action, float).ravel())
        return s, -reward, *rest


class NaiveNmpc(Mpc[ca.SX]):
    """The paper's NMPC with the naive guess, learnable where `start` names a parameter."""

    def __init__(self, problem, start):
        super().__init__(Nlp[ca.SX](), problem.horizon)
        n, m, N = problem.n_states, problem.n_actions, problem.horizon
        x, _ = self.state("x", n, bound_initial=False)
        u, _ = self.action(
            "u", m, lb=problem.action_lower[:, None], ub=problem.action_upper[:, None]
        )
        slack, _, _ = self.variable("slack", (n, N), lb=0)
        theta = {name: self.parameter(name, (len(value), 1)) for name, value in start.items()}
        model = problem.model
        step = discretise(model, problem.sampling_time, problem.substeps)
        d, p = model.nominal_disturbance, model.nominal_parameters
        for k in range(N):
            following = step(x[:, k], u[:, k], d, p) + theta["c_f"]
            self.constraint(f"dynamics_{k}", x[:, k + 1], "==", following)
        self.constraint("lower", theta["x_l"] - slack, "<=", x[:, 1:])
        self.constraint("upper", x[:, 1:], "<=", problem.state_upper + slack)
        gamma = problem.discount
        cost = theta["c_lambda"] + gamma**N * ca.sumsqr(x[:, N] - problem.reference_state)
        for k in range(N):
            w = ca.vertcat(x[:, k] - problem.reference_state, u[:, k] - problem.reference_action)
            s = slack[:, k]
            penalty = ca.dot(problem.penalty_linear, s) + ca.dot(problem.penalty_quadratic, s**2)
            cost += gamma**k * (ca.sumsqr(w) + ca.dot(theta["b_l"], w)) + gamma ** (k + 1) * penalty
        self.minimize(cost)
        ipopt = {"max_iter": 300, "sb": "yes", "print_level": 0}
        self.init_solver({"expand": True, "print_time": False, "ipopt": ipopt}, solver="ipopt")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("mpcrl.toml"))
    arguments = parser.parse_args()
    scenario = Scenario.load(arguments.scenario)
    problem = Problem.from_scenario(scenario)
    start = {
        "c_lambda": np.array([problem.reference_cost / (1.0 - problem.discount)]),
        "b_l": np.zeros(problem.n_states + problem.n_actions),
        "c_f": np.zeros(problem.n_states),
        "x_l": problem.state_lower.copy(),
    }
    mpc = NaiveNmpc(problem, start)
    learnable = LearnableParametersDict[ca.SX](
        LearnableParameter(name, value.shape, value) for name, value in start.items()
    )
    agent = LstdQLearningAgent(
        mpc=mpc,
        learnable_parameters=learnable,
        discount_factor=problem.discount,
        update_strategy=UpdateStrategy(100),
        optimizer=NewtonMethod(learning_rate=0.3, max_percentage_update=0.2),
        hessian_type="approx",
        exploration=EpsilonGreedyExploration(
            epsilon=0.3, strength=10.0, mode="additive", seed=arguments.seed
        ),
        remove_bounds_on_initial_action=True,
    )
    env = gymnasium.make("cosim/Evaporator-v0", scenario=scenario)
    env = Costs(gymnasium.wrappers.TimeLimit(env.unwrapped, arguments.steps))
    agent.train(env=env, episodes=1, seed=arguments.seed, raises=False)
    learnt = {name: np.ravel(learnable.value_as_dict[name]) for name in start}
    learnt["c_lambda"] = float(learnt["c_lambda"][0])
    print(learnt)
    Parameters.naive(problem).replace(learnt).save(arguments.out)


if __name__ == "__main__":
    main()
