import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cosim.environment import Normalisation, NormalisedEnv, PlantEnv


@pytest.fixture
def env(paper):
    with PlantEnv(paper) as plant:
        yield NormalisedEnv(plant, paper)


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version:UserWarning")
def test_passes_the_checker():
    env = gymnasium.make("cosim/EvaporatorNormalised-v0")
    check_env(env, skip_render_check=True)
    env.close()


def test_the_operating_point_is_zero_in_state_and_reward(paper):
    normalisation = Normalisation(paper)
    np.testing.assert_array_equal(normalisation.observation(paper.reference_state), 0.0)
    assert normalisation.reward(paper.controller.reference_cost) == 0.0


@pytest.mark.parametrize(("normalised", "share"), [(-1.0, 0.0), (0.0, 0.5), (1.0, 1.0), (7.0, 1.0)])
def test_actions_span_the_range(paper, normalised, share):
    lower, upper = paper.action_lower, paper.action_upper
    action = Normalisation(paper).action([normalised, normalised])
    np.testing.assert_allclose(action, lower + share * (upper - lower), rtol=1e-15)


def test_a_step_is_the_plants_own_in_other_units(env, paper):
    normalisation = Normalisation(paper)
    with PlantEnv(paper) as plant:
        plant.reset(seed=4)
        env.reset(seed=4)
        s, reward, *_ = plant.step(normalisation.action([0.3, -0.2]))
        seen, scaled, *_ = env.step(np.array([0.3, -0.2]))
    np.testing.assert_array_equal(seen, normalisation.observation(s))
    assert scaled == normalisation.reward(-reward)
