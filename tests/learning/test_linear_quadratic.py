"""Theory as the oracle: with the exact model class, each rule finds the Riccati solution."""

import numpy as np
import pytest

from controllers.converged import ConvergedNmpc
from controllers.rti import RtiNmpc
from learning import ActorCritic, BatchQLearning, QLearning
from tests.helpers.linear_quadratic import DISCOUNT
from tests.helpers.training import looped


def learn(*arguments, **settings):
    """The controller that `train` leaves."""
    return train(*arguments, **settings)[0]


def train(task, cls, samples, noise, controller=None, constant=0.0, plant_gain=1.0, **settings):
    """Controller and algorithm after training on the task, with a constant added to its cost.

    `plant_gain` is the gain of the plant over that of the controller's model.
    """
    configuration = cls.Configuration.from_dict(
        {"parametrisation": "paper", "value_offset": "stage-cost", **settings}
    )
    controller = controller or RtiNmpc(task.problem, task.wrong())
    plant = task.plant(noise, constant=constant, gain=plant_gain)
    interaction = looped(cls, plant, controller, configuration, samples, exploration=1, seed=7)
    algorithm = interaction.algorithm
    for _ in range(samples):
        sample, _ = interaction.next()
        if algorithm.observe(sample) is not None:
            interaction.renew()
    return controller, algorithm


def gain(controller):
    """−dπ/ds at the origin, (m, n)."""
    controller.reset()
    return -controller.feedback(np.zeros(2)).policy_state_jacobian


def value_hessian(controller):
    """P of V(s) = sᵀPs + …, by exact differences of a quadratic function."""
    e = np.eye(2)

    def at(s):
        controller.reset()
        return controller.value(s)

    zero = at(np.zeros(2))
    diagonal = [(at(v) + at(-v)) / 2 - zero for v in e]
    cross = (at(e[0] + e[1]) + at(-e[0] - e[1])) / 2 - zero - sum(diagonal)
    return np.array([[diagonal[0], cross / 2], [cross / 2, diagonal[1]]])


def test_exact_parameters_alone_give_the_riccati_value_and_gain(linear_quadratic):
    wrong = RtiNmpc(linear_quadratic.problem, linear_quadratic.wrong())
    assert np.abs(gain(wrong) - linear_quadratic.K).max() > 0.05
    assert np.abs(value_hessian(wrong) - linear_quadratic.P).max() > 0.5
    controller = RtiNmpc(linear_quadratic.problem, linear_quadratic.exact())
    assert gain(controller) == pytest.approx(linear_quadratic.K, abs=1e-7)
    assert value_hessian(controller) == pytest.approx(linear_quadratic.P, abs=1e-6)


EXPLORATION = {
    "exploration_probability": 0.5,
    "exploration_deviation": (1.0,),
    "exploration_decay_after": None,
}
LQ = {"measure_offset": True, "discount": DISCOUNT, **EXPLORATION}
ONLINE = {"prior_width": 1.0, "prior_samples": 50, "step_every": 10, **LQ}
BATCH = {"prior_width": 3.0, "batch_size": 50, "first_batch": None, "variance_memory": 50.0, **LQ}


RULES = [
    (QLearning, {"parameter_drift": 1e-3, "variance_memory": 50.0, **ONLINE}),
    (BatchQLearning, BATCH),
]


@pytest.mark.parametrize(("rule", "settings"), RULES)
def test_q_learning_finds_the_riccati_solution(linear_quadratic, rule, settings):
    controller = learn(linear_quadratic, rule, 4000, 0.0, **settings)
    assert gain(controller) == pytest.approx(linear_quadratic.K, abs=1e-3)
    assert value_hessian(controller) == pytest.approx(linear_quadratic.P, rel=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize(("rule", "settings"), RULES)
def test_td_errors_of_the_mean_cost_lead_to_its_riccati_gain(linear_quadratic, rule, settings):
    exact = linear_quadratic.riccati(1.0)[1]
    assert np.abs(exact - linear_quadratic.K).max() > 0.04
    controller = learn(linear_quadratic, rule, 4000, 0.0, **settings | {"discount": 1.0})
    assert gain(controller) == pytest.approx(exact, abs=0.01)


@pytest.mark.slow
def test_the_mean_cost_is_fitted_beside_theta(linear_quadratic):
    noise = 0.1
    exact = noise**2 * np.trace(linear_quadratic.riccati(1.0)[0])
    settings = BATCH | {"discount": 1.0, "intercept": False}
    _, algorithm = train(linear_quadratic, BatchQLearning, 3000, noise, **settings)
    assert algorithm._average_cost.mean_cost == pytest.approx(exact, rel=0.2)


MEAN_COST = [
    (QLearning, {"mean_cost_memory": 5.0, **ONLINE, "discount": 1.0}),
    (QLearning, {"mean_cost_memory": 0.0, **ONLINE, "discount": 1.0}),
    (BatchQLearning, BATCH | {"discount": 1.0}),
    (BatchQLearning, BATCH | {"discount": 1.0, "intercept": False}),
    (ActorCritic, {"batch_size": 100, "exploration_deviation": (1.0,)}),
]


@pytest.mark.parametrize(("rule", "settings"), MEAN_COST)
def test_a_constant_in_the_cost_does_not_change_where_theta_goes(linear_quadratic, rule, settings):
    """At γ = 1 it moves the mean cost alone, from which no policy follows."""
    without = learn(linear_quadratic, rule, 200, 0.3, **settings).theta
    with_constant = learn(linear_quadratic, rule, 200, 0.3, constant=1e4, **settings).theta
    way = without - linear_quadratic.wrong().theta
    assert np.abs(way).max() > 0.01, "the rule must have moved"
    assert with_constant - without == pytest.approx(0.0, abs=1e-6 * np.abs(way).max())


@pytest.mark.slow
def test_noise_leaves_online_q_learning_near_the_riccati_gain(linear_quadratic):
    settings = {"parameter_drift": 1e-6, **ONLINE}
    controller = learn(linear_quadratic, QLearning, 20_000, 0.1, **settings)
    assert gain(controller) == pytest.approx(linear_quadratic.K, abs=0.03)


@pytest.mark.slow
def test_actor_critic_finds_the_riccati_gain_of_the_mean_cost(linear_quadratic):
    exact = linear_quadratic.riccati(1.0)[1]
    assert np.abs(exact - linear_quadratic.K).max() > 0.04
    controller = learn(linear_quadratic, ActorCritic, 2400, 0.5)
    assert gain(controller) == pytest.approx(exact, abs=0.02)


@pytest.mark.slow
def test_the_compatible_advantage_corrects_a_wrong_gain_of_the_model(linear_quadratic):
    """Without exploration the rule ends where the model's own gain is the best one."""
    exact = linear_quadratic.riccati(1.0, gain=0.6)[1]
    error = {}
    for probability in (0.0, 1.0):
        controller = learn(
            linear_quadratic, ActorCritic, 9600, 0.5, plant_gain=0.6,
            exploration_probability=probability, exploration_deviation=(1.0,), advantage_width=1.0,
        )  # fmt: skip
        error[probability] = np.abs(gain(controller) - exact).max()
    assert error[0.0] > 0.2
    assert error[1.0] < 0.1


@pytest.mark.slow
def test_converged_nmpc_learns_the_same_on_a_linear_plant(linear_quadratic):
    converged = ConvergedNmpc(linear_quadratic.problem, linear_quadratic.wrong())
    controller = learn(linear_quadratic, BatchQLearning, 2000, 0.0, converged, **BATCH)
    assert gain(controller) == pytest.approx(linear_quadratic.K, abs=2e-3)
