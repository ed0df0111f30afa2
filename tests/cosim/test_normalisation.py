import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cosim.environment import NormalisedEnv, PlantEnv


@pytest.fixture
def env(paper):
    with NormalisedEnv(paper) as env:
        yield env


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version:UserWarning")
def test_passes_the_checker():
    env = gymnasium.make("cosim/EvaporatorNormalised-v0")
    check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.parametrize(("normalised", "share"), [(-1.0, 0.0), (0.3, 0.65), (7.0, 1.0)])
def test_a_step_is_the_plants_own_in_other_units(env, paper, normalised, share):
    lower, upper = paper.action_lower, paper.action_upper
    with PlantEnv(paper) as plant:
        plant.reset(seed=4)
        env.reset(seed=4)
        s, reward, *_ = plant.step(lower + share * (upper - lower))
        seen, scaled, *_ = env.step(np.array([normalised, normalised]))
    point, cost = paper.reference_state, paper.controller.reference_cost
    np.testing.assert_allclose(seen, 10 * (s / point - 1), rtol=1e-5, atol=1e-6)
    assert scaled == pytest.approx(10 * (1 + reward / cost), rel=1e-12)
