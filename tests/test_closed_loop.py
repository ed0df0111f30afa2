"""The parts together: FMU plant, scenario and RTI-NMPC in the loop."""

import numpy as np
import pytest

from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate


def with_backend(scenario, backend):
    return scenario.replace({"controller": {"backend": backend}})


@pytest.mark.parametrize("backend", ["daqp", pytest.param("proxqp", marks=pytest.mark.slow)])
def test_rti_settles_at_the_economic_steady_state_from_feasible_starts(backend):
    scenario = with_backend(Scenario.load("nominal"), backend)
    starts = np.random.default_rng(2).uniform(scenario.state_lower, scenario.state_upper, (2, 2))
    corners = [[25.0, 40.0], [100.0, 40.0], [25.0, 80.0], [100.0, 80.0]]
    for start in [*corners, *starts.tolist()]:
        with FmuPlant(scenario.replace({"plant": {"initial_state": list(start)}})) as plant:
            trajectory = simulate(plant, naive(scenario), 1500, seed=0)
        assert trajectory.summary()["failures"] == 0
        for reached, goal in (
            (trajectory.final_state, scenario.reference_state),
            (trajectory.actions[-1], scenario.reference_action),
        ):
            np.testing.assert_allclose(reached, goal, rtol=0, atol=1e-3, err_msg=f"from {start}")


@pytest.mark.parametrize("backend", ["daqp", "proxqp"])
def test_ten_thousand_consecutive_qps_are_solved_to_the_residual_asked_for(backend):
    scenario = with_backend(Scenario.load("paper"), backend)
    with FmuPlant(scenario) as plant:
        trajectory = simulate(plant, naive(scenario), 10_000, seed=7)
    assert trajectory.summary()["statuses"] == {"solved": 10_000}
    assert trajectory["residual"].max() <= 1e-6
