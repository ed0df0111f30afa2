import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cosim import FmuPlant, Scenario, simulate
from cosim.core.errors import PlantError, ScenarioError
from cosim.environment import NormalisedEnv, PlantEnv
from tests.helpers.loop import Proportional

# Actions are in physical units on purpose; the checker recommends a normalised space.
NORMALISED = "ignore:.*symmetric and normalized space.*:UserWarning"


@pytest.fixture
def env():
    env = gymnasium.make("cosim/Evaporator-v0")
    yield env
    env.close()


@pytest.mark.filterwarnings("error", NORMALISED)
def test_passes_the_checker(env):
    check_env(env.unwrapped)


def test_an_episode_is_rendered_from_its_first_state_on():
    env = gymnasium.make("cosim/Evaporator-v0", render_mode="rgb_array")
    env.reset(seed=0)
    start = env.render()
    env.step(np.array([200.0, 300.0]))
    later = env.render()
    assert start.dtype == np.uint8
    assert start.shape == later.shape == (*start.shape[:2], 3)
    assert not np.array_equal(start, later)
    env.close()


def test_a_seeded_episode_is_the_simulated_run_of_that_seed(env, paper):
    with FmuPlant(paper) as plant:
        trajectory = simulate(plant, Proportional(paper), 50, seed=12)
    observation, _ = env.reset(seed=12)
    for k in range(50):
        np.testing.assert_array_equal(observation, trajectory.states[k])
        observation, reward, terminated, truncated, info = env.step(trajectory.actions[k])
        assert reward == -(trajectory["stage_cost"][k] + trajectory["penalty"][k])
        assert info["stage_cost"] == trajectory["stage_cost"][k]
        assert info["penalty"] == trajectory["penalty"][k]
        np.testing.assert_array_equal(info["disturbance"], trajectory.disturbances[k])
        assert not terminated
        assert not truncated


def test_later_episodes_of_a_seed_differ_and_repeat(env):
    def episodes():
        rows = []
        for seed in (3, None, None):
            env.reset(seed=seed)
            rows.append(env.step(np.array([200.0, 200.0]))[0].tolist())
        return rows

    first = episodes()
    assert len({tuple(row) for row in first}) == 3
    assert episodes() == first


def test_episodes_can_start_from_a_given_state(env):
    start = np.array([30.0, 60.0])
    np.testing.assert_array_equal(env.reset(seed=0, options={"initial_state": start})[0], start)
    with pytest.raises(PlantError, match=r"unknown reset option \['start'\]"):
        env.reset(options={"start": start})


def test_the_vector_form_is_many_single_ones():
    vector = gymnasium.make_vec("cosim/Evaporator-v0", num_envs=3)
    singles = [PlantEnv() for _ in range(3)]
    states, _ = vector.reset(seed=5)
    for i, single in enumerate(singles):
        np.testing.assert_array_equal(single.reset(seed=5 + i)[0], states[i])
    actions = np.random.default_rng(0).uniform(50, 450, (20, 3, 2))
    for each in actions:
        states, rewards, terminated, truncated, info = vector.step(each)
        assert not terminated.any()
        assert not truncated.any()
        for i, single in enumerate(singles):
            observation, reward, _, _, single_info = single.step(each[i])
            np.testing.assert_array_equal(states[i], observation)
            assert rewards[i] == reward
            assert info["stage_cost"][i] == single_info["stage_cost"]
            np.testing.assert_array_equal(info["disturbance"][i], single_info["disturbance"])
    vector.close()
    for single in singles:
        single.close()


@pytest.fixture
def normalised_env(paper):
    with NormalisedEnv(paper) as env:
        yield env


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version:UserWarning")
def test_the_normalised_one_passes_the_checker():
    env = gymnasium.make("cosim/EvaporatorNormalised-v0")
    check_env(env, skip_render_check=True)
    env.close()


@pytest.mark.parametrize(("normalised", "share"), [(-1.0, 0.0), (0.3, 0.65), (7.0, 1.0)])
def test_a_step_is_the_plants_own_in_other_units(normalised_env, paper, normalised, share):
    lower, upper = paper.action_lower, paper.action_upper
    with PlantEnv(paper) as plant:
        plant.reset(seed=4)
        normalised_env.reset(seed=4)
        s, reward, *_ = plant.step(lower + share * (upper - lower))
        seen, scaled, *_ = normalised_env.step(np.array([normalised, normalised]))
    point, cost = paper.reference_state, paper.controller.reference_cost
    np.testing.assert_allclose(seen, 10 * (s / point - 1), rtol=1e-5, atol=1e-6)
    assert scaled == pytest.approx(10 * (1 + reward / cost), rel=1e-12)


def test_under_sensors_it_shows_the_last_readings_and_their_ages():
    env = PlantEnv("late")
    rows = [env.reset(seed=4)[0]]
    for _ in range(32):
        rows.append(env.step(env.scenario.reference_action)[0])
    readings = np.array(rows)
    assert env.observation_space.contains(readings[-1])
    # X2 is taken at 0, 15, 30, … and comes 15 samples later; P2 comes at once.
    ages = [-1.0] * 15 + [15.0 + (k - 15) % 15 for k in range(15, 33)]
    assert readings[:, 2].tolist() == ages
    assert (readings[:15, 0] == 0.0).all()
    assert len(set(readings[15:30, 0])) == 1
    assert (readings[:, 3] == 0.0).all()
    with pytest.raises(PlantError, match="no normalised units"):
        NormalisedEnv("late")


def test_under_signals_it_shows_what_is_known_of_them():
    env = PlantEnv("set-point")
    rows = [env.reset(seed=4)[0]]
    for _ in range(240):
        rows.append(env.step(env.scenario.reference_action)[0])
    seen = np.array(rows)
    # The bound now, and one and two samples ahead: it steps at sample 240.
    assert env.observation_space.contains(seen[-1])
    assert seen[237, 2:].tolist() == [25.0, 25.0, 25.0]
    assert seen[238, 2:].tolist() == [25.0, 25.0, 30.0]
    assert seen[240, 2:].tolist() == [30.0, 30.0, 30.0]
    with pytest.raises(PlantError, match="no normalised units"):
        NormalisedEnv("set-point")


def test_a_measured_disturbance_is_foreseen_for_an_episode():
    env = PlantEnv("forecast", most_steps=3)
    s, _ = env.reset(seed=4)
    for _ in range(3):
        present = s[[2, 13]]
        s, _, _, _, info = env.step(env.scenario.reference_action)
        # X1 and T1, each with its preview of ten samples.
        assert present.tolist() == info["disturbance"][[0, 2]].tolist()
    with pytest.raises(PlantError, match="beyond 3 samples"):
        env.step(env.scenario.reference_action)


def test_a_signal_that_ends_too_early_is_refused(paper):
    signal = {"name": "low", "values": [25.0], "once": 600.0, "bound": "x_l[X2]", "known": "now"}
    scenario = Scenario.from_dict(paper.to_dict() | {"signal": [signal]})
    with pytest.raises(ScenarioError, match="ends after 600 s"):
        PlantEnv(scenario)
    assert PlantEnv(scenario, most_steps=9).reset(seed=0)[0].shape == (3,)
