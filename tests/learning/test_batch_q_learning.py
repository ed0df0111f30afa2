import numpy as np

from controllers.errors import QpError
from controllers.rti import RtiNmpc
from cosim import FmuPlant
from learning import BatchQLearning
from learning.exploration import build_strategy
from learning.loop import TrainingLoop, begin
from learning.training_run import TrainingRun


class Bench:
    """BatchQLearning on the linear-quadratic task, batch after batch."""

    def __init__(self, task, controller=None, noise=0.3, **settings):
        configuration = BatchQLearning.Configuration.from_dict(
            {
                "parametrisation": "paper",
                "value_offset": "stage-cost",
                "exploration_deviation": (1.0,),
                "batch_size": 20,
                **settings,
            }
        )
        self.controller = controller or RtiNmpc(task.problem, task.wrong())
        strategy = build_strategy(configuration, task.scenario, 1000)
        self.algorithm = BatchQLearning(
            self.controller, task.scenario, configuration, 1000, strategy, np.random.default_rng(0)
        )
        plant = task.plant(noise)
        self.interaction = TrainingLoop(
            plant, self.controller, self.algorithm, strategy, np.random.default_rng(2)
        )
        self.interaction.start(plant.reset(3))

    def update(self):
        """Samples until θ moves."""
        for _ in range(1000):
            sample, _ = self.interaction.next()
            update = None if sample is None else self.algorithm.observe(sample)
            if update is not None:
                self.interaction.renew()
                return update
        raise AssertionError("θ never moved")


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
    assert 0 < bench.update().failures <= 40


def test_a_first_batch_has_its_own_length_and_a_start_may_keep_its_offset(scenario, problem):
    algorithm = BatchQLearning
    settings = {"first_batch": 60, "batch_size": 20}
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
