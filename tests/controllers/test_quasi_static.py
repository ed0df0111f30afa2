"""The quasi-static reference of a plant that fouls or jumps, and the optimum of any."""

import numpy as np
import pytest

from controllers.errors import OptimumError
from controllers.factories import optimal, stored_optimum
from controllers.optimum import QuasiStaticPolicy, change_of, fouling
from cosim import FmuPlant, Scenario


@pytest.fixture(scope="module")
def drifting():
    return Scenario.load("drifting")


@pytest.fixture(scope="module")
def policy(drifting):
    return QuasiStaticPolicy.from_scenario(drifting)


def test_the_law_of_fouling_is_the_fmus(drifting):
    name, value = fouling(drifting)
    assert name == "UA2"
    seen = drifting.replace(
        {
            "sampling_time": 21600.0,
            "plant": {
                "disturbances": ["UA2_present"],
                "mapping": {"nominal": [], "ranges": [], "time_constant": []},
            },
            "disturbance": {"law": "none", "nominal": [], "ranges": []},
        }
    )
    with FmuPlant(seen) as plant:
        plant.reset(0)
        found = [plant.step(seen.reference_action).disturbance[0] for _ in range(60)]
    np.testing.assert_allclose(found, value(21600.0 * np.arange(60)), rtol=1e-9)
    assert min(found) < 5.2
    assert max(found) > 6.8


def test_a_condenser_that_does_not_foul_has_no_law():
    assert fouling(Scenario.load("paper")) is None
    still = Scenario.load("drifting").replace({"plant": {"parameters": {"fouling_floor": 1.0}}})
    assert fouling(still) is None
    never = Scenario.load("drifting").replace({"plant": {"parameters": {"cleaning_period": 0.0}}})
    with pytest.raises(OptimumError):
        fouling(never)


def test_the_reference_is_the_mean_of_the_optima_along_the_cycle(policy, drifting):
    nodes, gains = policy.law.parameters["UA2"], np.array(policy.gains)
    assert nodes[-1] == 6.84
    assert (np.diff(gains) < 0).all()
    days = (np.arange(20_000) + 0.5) * 6.0 / 20_000
    linear = np.interp(fouling(drifting)[1](86400.0 * days), nodes, gains).mean()
    assert policy.gain == pytest.approx(linear, rel=1e-3)
    assert gains[-1] < policy.gain < gains[0]


def test_the_policy_follows_the_clock_between_the_tables(policy):
    s = [28.0, 60.0]
    policy.reset()
    policy.prepare()
    np.testing.assert_allclose(policy.feedback(s).action, policy.policies[-1].feedback(s).action)
    for _ in range(8639):
        policy.prepare()
    np.testing.assert_allclose(
        policy.feedback(s).action, policy.policies[0].feedback(s).action, rtol=1e-3
    )
    policy.prepare()
    np.testing.assert_allclose(policy.feedback(s).action, policy.policies[-1].feedback(s).action)
    policy.reset()
    for _ in range(2000):
        policy.prepare()
    low, high = policy.policies[0].feedback(s).action, policy.policies[-1].feedback(s).action
    between = policy.feedback(s).action
    assert (between > np.minimum(low, high)).all()
    assert (between < np.maximum(low, high)).all()


def test_a_plant_that_jumps_has_the_optimum_of_the_plant_as_it_is():
    jump = Scenario.load("jump")
    policy, before, after = map(optimal, (jump, Scenario.load("paper"), Scenario.load("fouled")))
    first, second = (change.time for change in jump.plant.changes)
    times = [0.0, first - 60.0, first, second - 60.0, second, 1e9]
    expected = [before.gain] * 2 + [after.gain] * 2 + [before.gain] * 2
    assert policy.gain_at(times).tolist() == expected
    share = first / second
    assert policy.gain == pytest.approx(share * before.gain + (1 - share) * after.gain)
    s = [28.0, 60.0]
    policy.reset()
    for _ in range(int(first / 60.0)):
        policy.prepare()
    np.testing.assert_array_equal(policy.feedback(s).action, before.feedback(s).action)
    policy.prepare()
    np.testing.assert_array_equal(policy.feedback(s).action, after.feedback(s).action)


def test_a_plant_cannot_foul_and_jump():
    changes = [{"time": 60.0, "parameters": {"UA2": 5.2}}]
    with pytest.raises(OptimumError, match="no common reference"):
        change_of(Scenario.load("drifting").replace({"plant": {"changes": changes}}))


def test_what_is_not_stored_is_not_had(tmp_path, monkeypatch):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path))
    other = Scenario.load("paper").replace({"plant": {"parameters": {"UA2": 6.5}}})
    assert stored_optimum(other) is None
    slower = Scenario.load("drifting").replace({"plant": {"parameters": {"cleaning_period": 7.0}}})
    assert stored_optimum(slower) is None
