"""What sensors show of a plant: the right value at the right sample, with the noise of a seed."""

import math

import numpy as np
import pytest

from controllers.factories import build_controller
from cosim import FmuPlant, Scenario, simulate
from cosim.core.errors import CosimError, PlantError, ScenarioError
from cosim.core.scenario import SensorTable
from cosim.core.sensors import DRAWS_AT_ONCE, Sensors

SEED = 2**64 - 1


def with_sensors(*tables, name="paper"):
    """A preset with sensors."""
    return Scenario.load(name).replace({"sensor": list(tables)})


def readings(tables, values, seed=SEED):
    """All readings (K, n_y) of values (K, n_y)."""
    sensors = Sensors([SensorTable(**table) for table in tables])
    rows = [sensors.start(seed, values[0])]
    for k in range(1, len(values)):
        rows.append(sensors.read(k, values[k]))
    return np.array(rows)


@pytest.mark.parametrize(("every", "delay"), [(1, 0), (1, 3), (4, 0), (4, 3), (3, 7)])
def test_a_reading_is_the_value_at_its_sample_and_arrives_late(every, delay):
    values = np.arange(40.0)[:, None] ** 2
    y = readings([{"variable": "x", "every": every, "delay": delay}], values)[:, 0]
    for k in range(40):
        taken = k - delay
        if taken >= 0 and taken % every == 0:
            assert y[k] == values[taken, 0]
        else:
            assert math.isnan(y[k])


def test_the_noise_is_standard_normal_white_and_of_one_sensor_alone():
    count = 40 * DRAWS_AT_ONCE
    tables = [{"variable": name, "deviation": 2.0} for name in ("a", "b")]
    noise = readings(tables, np.zeros((count, 2))) / 2.0
    # Three standard errors of each estimate.
    assert abs(noise.mean(axis=0)).max() < 3 / math.sqrt(count)
    assert abs(noise.var(axis=0) - 1).max() < 3 * math.sqrt(2 / count)
    pairs = [(noise[1:, 0], noise[:-1, 0]), (noise[:, 0], noise[:, 1])]
    for one, other in pairs:
        assert abs(np.corrcoef(one, other)[0, 1]) < 3 / math.sqrt(count)


def test_the_noise_is_a_function_of_seed_sensor_and_sample():
    values = np.zeros((30, 1))
    table = {"variable": "x", "deviation": 1.0}
    every_sample = readings([table], values, seed=7)
    late = readings([table | {"every": 2, "delay": 4}], values, seed=7)
    assert np.array_equal(late[4::2], every_sample[:-4:2])
    assert not np.array_equal(every_sample, readings([table], values, seed=8))


def test_a_plant_goes_back_with_its_readings():
    scenario = with_sensors(
        {"variable": "X2", "every": 3, "delay": 4, "deviation": 0.1},
        {"variable": "F2", "deviation": 0.2},
    )
    a = scenario.reference_action

    def next_readings(plant):
        return np.array([plant.step(a).y for _ in range(12)])

    with FmuPlant(scenario) as plant:
        plant.reset(3)
        next_readings(plant)
        snapshot = plant.snapshot()
        carried = plant.serialise(snapshot)
        y = plant.y
        whole = next_readings(plant)
        plant.restore(snapshot)
        assert np.array_equal(plant.y, y, equal_nan=True)
        assert np.array_equal(next_readings(plant), whole, equal_nan=True)
        with FmuPlant(scenario) as other:
            other.restore(other.deserialise(carried))
            assert np.array_equal(next_readings(other), whole, equal_nan=True)
            with pytest.raises(PlantError, match="these bytes are not"):
                other.deserialise(carried[:48])


def test_sensors_change_neither_the_plant_nor_the_hash_of_a_scenario_without_them():
    scenario = Scenario.load("paper")
    assert "sensor" not in scenario.to_dict()
    measured = with_sensors({"variable": "P2", "deviation": 1.0})
    a = scenario.reference_action
    with FmuPlant(scenario) as plain, FmuPlant(measured) as seen:
        assert np.array_equal(plain.reset(5), seen.reset(5))
        assert plain.y is None
        for _ in range(5):
            one, other = plain.step(a), seen.step(a)
            assert np.array_equal(one.s, other.s)
            assert one.y is None
            assert other.y.shape == (1,)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": []}, "sensor"),
        ({"sensor": [{"variable": "X2"}, {"variable": "X2"}]}, "two of them read 'X2'"),
        ({"sensor": [{"variable": "X2", "every": 0}]}, "every"),
        ({"sensor": [{"variable": "X2", "deviation": -1.0}]}, "deviation"),
        ({"sensor": [{"variable": "X2", "delay": 1.5}]}, "delay"),
        ({"estimator": {"kind": "ekf"}}, "no \\[\\[sensor\\]\\]"),
        (
            {"sensor": [{"variable": "X2"}], "estimator": {"sensor_deviation": [1.0, 1.0]}},
            "one entry per sensor",
        ),
        ({"sensor": [{"variable": "X2"}], "estimator": {"kind": "kalman"}}, "kind"),
    ],
)
def test_wrong_sensors_are_refused_in_one_line(changes, message):
    with pytest.raises(ScenarioError, match=message) as error:
        Scenario.load("paper").replace(changes)
    assert "\n" not in str(error.value)


def test_a_sensor_of_no_variable_is_refused():
    with pytest.raises(PlantError, match="no variable 'X9'"):
        FmuPlant(with_sensors({"variable": "X9"}))


def test_a_sensor_whose_first_reading_comes_after_the_run_is_refused():
    scenario = with_sensors({"variable": "X2"}, {"variable": "P2", "delay": 30})
    controller = build_controller("naive", scenario)
    with FmuPlant(scenario) as plant:
        with pytest.raises(ScenarioError, match=r"sensor of 'P2' is never read: .* 30 samples"):
            simulate(plant, controller, 30, 0)
        simulate(plant, controller, 31, 0)


def test_a_controller_of_the_state_is_refused_where_there_are_sensors():
    controller = build_controller("naive", Scenario.load("paper"))
    with (
        FmuPlant(with_sensors({"variable": "X2"})) as plant,
        pytest.raises(CosimError, match="OutputFeedback"),
    ):
        simulate(plant, controller, 3, 0)


def test_the_optimum_sees_the_state():
    runs = []
    for scenario in (Scenario.load("paper"), Scenario.load("assay")):
        with FmuPlant(scenario) as plant:
            runs.append(simulate(plant, build_controller("optimal", scenario), 50, 1))
    assert np.array_equal(runs[0].actions, runs[1].actions)


def test_a_run_keeps_truth_readings_and_estimates():
    scenario = Scenario.load("late")
    with FmuPlant(scenario) as plant:
        run = simulate(plant, build_controller("naive", scenario), 40, 1)
    X2, read, estimated = run["X2"], run["measured[X2]"], run["estimated[X2]"]
    arrived = np.flatnonzero(~np.isnan(read))
    assert arrived.tolist() == [15, 30]
    assert np.array_equal(read[arrived], X2[arrived - 15])
    assert np.isfinite(estimated).all()
    assert run.signals["measured[P2]"].unit == "kPa"
