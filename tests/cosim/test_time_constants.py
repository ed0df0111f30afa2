"""Disturbances with a time constant: their statistics, seeds, and what must refuse them."""

import tomllib

import numpy as np
import pytest

from controllers import OptimalPolicy
from controllers.errors import OptimumError
from controllers.factories import naive, stored_optimum
from controllers.problem import PlantProblem
from cosim import FmuPlant, Scenario, simulate
from cosim.core.errors import PlantError, ScenarioError
from cosim.core.scenario import random_coloured_plant, random_plant
from cosim.plant.draft import draft_scenario
from fmus.plant import Signal, build_plant, plant_model
from tests.helpers.compiler import needs_compiler

TIME_CONSTANTS = [120.0, 300.0, 600.0, 0.0]
SAMPLES = 30_000


def disturbances(plant, samples: int, seed: int) -> np.ndarray:
    """Deviations from the nominal values in ranges, (K, p)."""
    law = plant.scenario.disturbance
    plant.reset(seed)
    rows = [plant.step(plant.scenario.reference_action).disturbance for _ in range(samples)]
    return (np.array(rows) - law.nominal) / law.ranges


@pytest.mark.parametrize(("law", "variance"), [("uniform", 1 / 3), ("normal", 1.0)])
def test_mean_variance_and_autocorrelation_are_those_of_theory(paper, law, variance) -> None:
    table = {"law": law, "time_constant": TIME_CONSTANTS, "ranges": [0.2, 0.4, 1.6, 1.0]}
    with FmuPlant(paper.replace({"disturbance": table})) as plant:
        x = disturbances(plant, SAMPLES, seed=5)
    phi = np.exp(-60.0 / np.maximum(TIME_CONSTANTS, 1e-3))
    # Bartlett: with autocorrelation φⁿ there are so many independent samples for mean and variance.
    for_mean = SAMPLES * (1 - phi) / (1 + phi)
    for_variance = SAMPLES * (1 - phi**2) / (1 + phi**2)
    assert (np.abs(x.mean(axis=0)) < 4.5 * np.sqrt(variance / for_mean)).all()
    squares = 4.5 * variance * np.sqrt(2 / for_variance)
    assert (np.abs(x.var(axis=0) - variance) < squares).all()
    for lag in (1, 5, 20):
        found = (x[lag:] * x[:-lag]).mean(axis=0)
        assert (np.abs(found - variance * phi**lag) < squares).all(), lag


def test_a_start_is_stationary_too(paper) -> None:
    """The first samples of many seeds have the law's deviation, and seeds nothing in common."""
    scenario = paper.replace({"disturbance": {"time_constant": [3600.0] * 4}})
    with FmuPlant(scenario) as plant:
        x = np.array([disturbances(plant, 3, seed) for seed in range(1500)])
    np.testing.assert_allclose(x.std(axis=0), 1 / np.sqrt(3), rtol=0.08)
    between_seeds = np.corrcoef(x[1:, 2].T, x[:-1, 2].T) - np.eye(8)
    assert np.abs(between_seeds).max() < 4.5 / np.sqrt(1499)


def test_a_serialised_plant_meets_the_same_values_in_another() -> None:
    scenario = Scenario.load("coloured-5")
    with FmuPlant(scenario) as plant:
        whole = disturbances(plant, 60, seed=3)
        np.testing.assert_array_equal(disturbances(plant, 30, seed=3), whole[:30])
        data = plant.serialise(plant.snapshot())
    with FmuPlant(scenario) as plant:
        plant.restore(plant.deserialise(data))
        steps = [plant.step(scenario.reference_action) for _ in range(30)]
    law = scenario.disturbance
    rest = (np.array([step.disturbance for step in steps]) - law.nominal) / law.ranges
    np.testing.assert_array_equal(rest, whole[30:])


def test_time_constants_of_zero_are_none(paper) -> None:
    zero = paper.replace({"disturbance": {"time_constant": [0.0] * 4}})
    assert zero.hash == paper.hash
    assert not zero.disturbance.coloured and zero.memory == 0.0
    runs = []
    for scenario in (paper, zero):
        with FmuPlant(scenario) as plant:
            runs.append(simulate(plant, naive(scenario), 50, seed=3))
    np.testing.assert_array_equal(runs[0].states, runs[1].states)
    assert Scenario.load("coloured-5").memory == 5.0
    assert Scenario.load("coloured-5").hash != Scenario.load("coloured-2").hash


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"disturbance": {"time_constant": [60.0]}}, "time_constant: must have one entry per"),
        ({"disturbance": {"time_constant": [-1.0] * 4}}, r"disturbance\.time_constant\[0\]"),
        ({"disturbance": {"time_constant": [60.0] * 4}}, "needs plant.mapping.time_constant"),
        ({"plant": {"mapping": {"time_constant": ["X1_time_constant"]}}}, "one entry per"),
    ],
)
def test_a_wrong_field_is_one_clear_line(paper, changes, words) -> None:
    document = paper.to_dict()
    del document["plant"]["mapping"]["time_constant"]
    without = Scenario.from_dict(document)
    with pytest.raises(ScenarioError, match=words) as error:
        without.replace(changes)
    assert "\n" not in str(error.value)


def test_a_time_constant_that_the_fmu_does_not_take_is_an_error(paper) -> None:
    longest = paper.replace({"disturbance": {"time_constant": [1e9] * 4}})
    with pytest.raises(PlantError, match="X1_time_constant"), FmuPlant(longest) as plant:
        plant.reset(0)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("coloured-2", "X1, F1, T1, T200 have one"),
        ("dead-time", "tank, pipe1, .*pipe7, and plant.states does not"),
    ],
)
def test_the_optimum_of_a_plant_with_hidden_states_is_refused(name, words) -> None:
    scenario = Scenario.load(name)
    with pytest.raises(OptimumError, match=words) as error:
        OptimalPolicy.from_scenario(scenario)
    assert "\n" not in str(error.value)
    assert stored_optimum(scenario) is None


FILTERED = """
#pragma once
#include "variables.h"
static void evaluate(double v[N_VARIABLES]) {
    v[VR_der_x] = v[VR_u] + v[VR_d] + v[VR_e] - v[VR_x];
    v[VR_cost] = v[VR_x];
}
"""


@needs_compiler
@pytest.mark.parametrize("version", [2, 3])
def test_a_plant_of_ones_own_has_a_time_constant_of_its_own(tmp_path, version) -> None:
    """A scenario that leaves it out draws anew; one that does not map it takes the FMU's."""
    table = plant_model(
        "lag",
        states=[Signal("x", "m", 0.0, -10.0, 10.0, "level")],
        inputs=[Signal("u", "m", 0.0, -1.0, 1.0, "inflow")],
        disturbances=[
            Signal("d", "m", 0.0, -9.0, 9.0, "rain", 0.5, time_constant=20.0),
            Signal("e", "m", 0.0, -9.0, 9.0, "snow", 0.5, time_constant=1.0),
        ],
        outputs=[Signal("cost", "1", 0.0, -9.0, 9.0, "cost")],
        sampling_time=2.0,
    )
    fmu = build_plant(table, FILTERED, tmp_path / "lag.fmu", version)
    drafted = Scenario.from_dict(tomllib.loads(draft_scenario(fmu, tmp_path / "lag.toml")))
    drafted = drafted.replace({"plant": {"fmu": str(fmu)}})
    assert drafted.disturbance.time_constant == (20.0, 1.0)
    document = drafted.to_dict()
    del document["disturbance"]["time_constant"]
    white = Scenario.from_dict(document)
    del document["plant"]["mapping"]["time_constant"]
    unmapped = Scenario.from_dict(document)
    series = []
    for scenario in (drafted, white, unmapped):
        with FmuPlant(scenario) as plant:
            series.append(disturbances(plant, 50, seed=3)[:, 0])
    phi = np.exp(-2.0 / 20.0)
    filtered = [series[1][0]]
    for w in series[1][1:]:
        filtered.append(phi * filtered[-1] + np.sqrt(1 - phi**2) * w)
    np.testing.assert_allclose(series[0], filtered, atol=1e-12)
    np.testing.assert_array_equal(series[2], series[0])
    for scenario in (drafted, unmapped):
        with pytest.raises(OptimumError, match="d, e have one"):
            PlantProblem.from_scenario(scenario)


def test_one_disturbance_with_a_memory_makes_a_state_of_the_optimum(paper) -> None:
    table = {"time_constant": [300.0, 0.0, 0.0, 0.0]}
    scenario = paper.replace({"disturbance": table})
    problem = PlantProblem.from_scenario(scenario)
    assert problem.memory is not None
    assert problem.memory.phi == pytest.approx(np.exp(-0.2))
    # The model's sample is the FMU's, from any value of the filter.
    step = problem.sampled(40)
    x, xi = np.array([27.0, 55.0]), 0.3
    w = np.array([-0.4, 11.0, 42.0, 24.0])
    realised = problem.memory.phi * xi + np.sqrt(1 - problem.memory.phi**2) * w[0]
    action = scenario.reference_action + 5.0
    after = step(np.append(x, xi), action, w, problem.parameters)
    assert float(after[2]) == pytest.approx(realised)
    given = {"override": True, "X1_in": 5.0 + realised, "F1_in": 11.0, "T1_in": 42.0}
    held = paper.replace({"plant": {"parameters": given | {"T200_in": 24.0}}})
    with FmuPlant(held) as plant:
        plant.reset(0, x)
        np.testing.assert_allclose(np.array(after).ravel()[:2], plant.step(action).s, rtol=1e-8)
    # Others vary, too: no two states in a row tell what X1 was.
    assert problem.unseen == "X1"
    alone = scenario.replace({"disturbance": table | {"ranges": [1.0, 0.0, 0.0, 0.0]}})
    assert PlantProblem.from_scenario(alone).unseen == ""
    with pytest.raises(OptimumError, match="the value that X1 had"):
        OptimalPolicy.from_scenario(alone)
    assert stored_optimum(alone) is None


def test_a_random_plant_with_time_constants_is_the_same_without_them() -> None:
    """And the first sixteen are those of the random plants that were there before."""
    longest = []
    for seed in range(32):
        plain, coloured = random_plant(seed), random_coloured_plant(seed)
        for field in ("sampling_time", "plant"):
            assert coloured[field] == plain[field]
        ranges = np.array(plain["disturbance"]["ranges"])
        np.testing.assert_allclose(coloured["disturbance"]["ranges"], 0.8 * ranges, rtol=1e-3)
        longest.append(max(coloured["disturbance"]["time_constant"]))
    assert min(longest) >= 60.0 and max(longest) <= 1200.0
    first = Scenario.load("random-coloured-0")
    assert first.disturbance.time_constant == (0.0, 0.0, 121.8, 0.0)
    assert Scenario.load("random-coloured-31").hash == "c41cdc3853fc2f7d"
