import numpy as np
import pytest

from cosim import FmuPlant, PlantPool
from cosim.errors import PlantError

ACTIONS = np.random.default_rng(3).uniform(100, 400, (20, 3, 2))


@pytest.mark.parametrize("fmu", ["evaporator", "evaporator_fmi3"])
def test_each_plant_of_a_pool_runs_as_if_alone(paper, fmu):
    with PlantPool(paper, 3, fmu) as pool:
        states = [pool.reset([4, 5, 4])]
        steps = [pool.step(actions) for actions in ACTIONS]
        states += [step.s for step in steps]
    for i, seed in enumerate([4, 5, 4]):
        with FmuPlant(paper, fmu) as plant:
            np.testing.assert_array_equal(plant.reset(seed), states[0][i])
            for actions, step in zip(ACTIONS, steps, strict=True):
                alone = plant.step(actions[i])
                np.testing.assert_array_equal(step.s[i], alone.s)
                np.testing.assert_array_equal(step.disturbance[i], alone.disturbance)
                assert step.stage_cost[i] == alone.stage_cost
                assert step.penalty[i] == alone.penalty


def test_plants_of_a_pool_share_one_unpacked_fmu(paper):
    with PlantPool(paper, 3) as pool:
        assert len({plant.unpacked.folder for plant in pool}) == 1
        assert len(pool) == 3


def test_misfitting_arguments_are_refused(paper):
    with pytest.raises(PlantError, match="at least 1"):
        PlantPool(paper, 0)
    with PlantPool(paper, 2) as pool:
        with pytest.raises(PlantError, match="2 plants, not 1 seeds"):
            pool.reset([1])
        pool.reset([1, 2])
        with pytest.raises(PlantError, match="2 plants, not 3 actions"):
            pool.step(ACTIONS[0])
