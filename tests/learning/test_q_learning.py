import numpy as np
import pytest

from controllers.rti import RtiNmpc
from cosim import FmuPlant
from learning import QLearning
from learning.exploration import build_strategy
from learning.loop import TrainingLoop
from learning.q_learning import AS_PRINTED
from learning.step import line_search
from learning.training_run import starting_parameters


class Bench:
    """QLearning on the evaporator, a sample at a time."""

    def __init__(self, plant, problem, **settings):
        self.scenario = plant.scenario
        configuration = QLearning.Configuration.from_dict(settings)
        self.controller = RtiNmpc(problem, starting_parameters(problem, configuration))
        strategy = build_strategy(configuration, self.scenario, 1000)
        self.algorithm = QLearning(
            self.controller, self.scenario, configuration, 1000, strategy, np.random.default_rng(0)
        )
        self.interaction = TrainingLoop(
            plant, self.controller, self.algorithm, strategy, np.random.default_rng(0)
        )
        self.interaction.start(plant.reset(11))

    def td_error(self, sample, target=None):
        """δ of a sample at the present θ, by its own linearisation point; and its target."""
        controller = self.controller
        if target is None:
            target = sample.cost + self.scenario.discount * sample.next_policy.value
        controller.prepare_at(sample.point)
        return target - controller.feedback(sample.s, sample.a).value, target


@pytest.fixture(scope="module")
def plant(scenario):
    with FmuPlant(scenario) as plant:
        yield plant


def test_the_papers_rule_takes_the_closed_form_step(plant, problem):
    bench = Bench(plant, problem, **AS_PRINTED)
    sample, _ = bench.interaction.next()
    delta = sample.cost + plant.scenario.discount * sample.next_policy.value
    delta -= sample.action_value.value
    gradient = sample.action_value.value_gradient
    expected = 1e-3 * delta * gradient / (1 + 1e-3 * gradient @ gradient)
    before = bench.controller.theta.copy()
    update = bench.algorithm.observe(sample)
    assert bench.controller.theta - before == pytest.approx(expected, rel=1e-6, abs=1e-9)
    assert update.td_error == pytest.approx(abs(delta))


def test_a_line_searched_step_never_raises_the_sampled_td_error(plant, problem, monkeypatch):
    lengths = []

    def watched(error):
        lengths.append(line_search(error))
        return lengths[-1]

    monkeypatch.setattr("learning.q_learning.line_search", watched)
    bench = Bench(plant, problem, **{**AS_PRINTED, "line_search": True, "step_size": 10.0})
    for _ in range(60):
        sample, _ = bench.interaction.next()
        before, target = bench.td_error(sample)
        bench.algorithm.observe(sample)
        after, _ = bench.td_error(sample, target)
        assert abs(after) <= abs(before) * (1 + 1e-9) + 1e-6
        bench.interaction.renew()
    assert len(lengths) == 60
    assert min(lengths) < 1.0 == max(lengths), "some steps are shortened, some are not"


def test_without_line_search_some_steps_do_raise_it(plant, problem):
    bench = Bench(plant, problem, **{**AS_PRINTED, "step_size": 10.0})
    raised = 0
    for _ in range(60):
        point = bench.controller.linearisation_point
        sample, _ = bench.interaction.next()
        if sample is None:
            continue
        sample = sample._replace(point=point)
        target = sample.cost + plant.scenario.discount * sample.next_policy.value
        before = target - sample.action_value.value
        bench.algorithm.observe(sample)
        raised += abs(bench.td_error(sample, target)[0]) > abs(before)
        bench.interaction.renew()
    assert raised > 0


def test_state_and_restore_carry_all_memory(plant, problem):
    bench, other = (Bench(plant, problem, prior_samples=20, step_every=30) for _ in range(2))
    samples = [bench.interaction.next()[0] for _ in range(50)]
    for sample in samples[:30]:
        bench.algorithm.observe(sample)
    other.controller.theta = bench.controller.theta
    other.algorithm.restore({k: v.copy() for k, v in bench.algorithm.state().items()})
    for sample in samples[30:]:
        first, second = bench.algorithm.observe(sample), other.algorithm.observe(sample)
    assert first == second
    assert np.array_equal(bench.controller.theta, other.controller.theta)
