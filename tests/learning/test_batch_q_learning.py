import numpy as np
import pytest

from controllers.errors import QpError
from controllers.rti import RtiNmpc
from cosim import FmuPlant
from learning import BatchQLearning
from learning.batch_q_learning import RULES, gauss_newton, projected_bellman, steepest_descent
from learning.interaction import Interaction
from learning.loop import begin
from learning.starting_point import build_strategy
from learning.training_run import TrainingRun


@pytest.fixture
def data(rng):
    gradient = rng.normal(size=(200, 5))
    jacobian = gradient - 0.9 * rng.normal(size=(200, 5))
    return gradient, jacobian, rng.normal(size=200)


def test_gauss_newton_solves_the_normal_equations(data):
    gradient, jacobian, errors = data
    step = gauss_newton(gradient, jacobian, errors, 0.0).minimiser
    assert step == pytest.approx(np.linalg.lstsq(gradient, errors)[0], rel=1e-5)


def test_lstdq_step_zeroes_the_projected_bellman_error(data):
    gradient, jacobian, errors = data
    step = projected_bellman(gradient, jacobian, errors, 0.0).minimiser
    left = gradient.T @ (errors - jacobian @ step)
    assert np.abs(left).max() < 1e-4 * np.abs(gradient.T @ errors).max()


def test_steepest_descent_goes_to_the_minimum_on_its_line(data):
    gradient, jacobian, errors = data
    step = steepest_descent(gradient, jacobian, errors, 0.0).minimiser

    def cost(t):
        return ((errors - t * (gradient @ step)) ** 2).sum()

    assert cost(1.0) < min(cost(0.9), cost(1.1))
    assert step @ (gradient.T @ errors) > 0


@pytest.mark.parametrize("name", RULES)
def test_every_rule_is_a_consistent_fit(data, name):
    fit = RULES[name](*data, 1e-2)
    assert fit.metric() @ fit.minimiser == pytest.approx(fit.gradient, rel=1e-6, abs=1e-9)


class Bench:
    """BatchQLearning on the linear-quadratic task, batch after batch."""

    def __init__(self, task, controller=None, noise=0.3, **settings):
        configuration = BatchQLearning.Configuration.from_dict(
            {
                "parametrisation": "paper",
                "value_offset": "stage-cost",
                "globalisation": "none",
                "rule": "gauss-newton",
                "exploration_deviation": (1.0,),
                "batch_size": 20,
                "buffer_size": 40,
                **settings,
            }
        )
        self.controller = controller or RtiNmpc(task.problem, task.wrong())
        strategy = build_strategy(configuration, task.scenario, 1000)
        self.algorithm = BatchQLearning(
            self.controller, task.scenario, configuration, 1000, strategy, np.random.default_rng(0)
        )
        self.interaction = Interaction(
            task.plant(noise), self.controller, self.algorithm, strategy, np.random.default_rng(2)
        )
        self.interaction.start(3)

    def update(self):
        """Samples until θ moves."""
        for _ in range(1000):
            sample, _ = self.interaction.next()
            update = None if sample is None else self.algorithm.observe(sample)
            if update is not None:
                self.interaction.renew()
                return update
        raise AssertionError("θ never moved")


@pytest.mark.parametrize("rule", ["gauss-newton", "lstdq"])
def test_a_step_that_is_taken_back_takes_the_mean_cost_back_too(linear_quadratic, rule):
    bench = Bench(
        linear_quadratic, rule=rule, discount=1.0, gain=1.0, gain_end=1.0, ridge=0.0, radius=1e3
    )
    before, taken_back = None, 0
    for _ in range(30):
        bench.update()
        state = {key: value.copy() for key, value in bench.algorithm.state().items()}
        if before is not None and np.array_equal(
            state["rule trial_theta"], before["rule trial_theta"]
        ):
            taken_back += 1
            assert state["rule trial_mean_cost"] == before["rule trial_mean_cost"]
            assert state["rule mean_cost"] != before["rule mean_cost"]
        before = state
    assert taken_back > 0


class FailsNow(RtiNmpc):
    """Fails at Q where told to, like a solver."""

    failing = False

    def feedback(self, s, a=None):
        if self.failing and a is not None:
            raise QpError("told to fail", status="failed")
        return super().feedback(s, a)


def test_an_update_counts_the_qps_that_failed_in_its_replay(linear_quadratic):
    controller = FailsNow(linear_quadratic.problem, linear_quadratic.wrong())
    bench = Bench(linear_quadratic, controller, exploration_probability=0.5)
    assert bench.update().failures == 0
    controller.failing = True
    assert 0 < bench.update().failures < 40


def test_a_first_batch_has_its_own_length_and_a_start_may_keep_its_offset(scenario, problem):
    algorithm = BatchQLearning
    settings = {"globalisation": "none", "first_batch": 60, "batch_size": 20}
    offsets = {}
    for measured in (True, False):
        configuration = algorithm.Configuration.from_dict(settings | {"measure_offset": measured})
        run = TrainingRun("batch-q-learning", scenario, 120, 3, configuration, start="tuned")
        with FmuPlant(scenario) as plant:
            learner = begin(run, algorithm, plant)
            updates = [learner.advance()[1] is not None for _ in range(120)]
        assert np.flatnonzero(updates).tolist() == [59, 79, 99, 119]
        offsets[measured] = learner.controller.parameters["c_f"]
    assert np.abs(offsets[False]).max() < 0.1 * np.abs(offsets[True]).max()
