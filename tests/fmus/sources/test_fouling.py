"""The law by which the condenser fouls and is cleaned."""

import numpy as np

DAY = 86400.0
ON = {"fouling_rate": 0.3, "fouling_floor": 0.7, "cleaning_period": 6.0}
FAST = {"fouling_rate": 20.0, "fouling_floor": 0.6, "cleaning_period": 0.05}  # 72 samples


def law(sample: np.ndarray, p: dict[str, float], sampling_time: float = 60.0) -> np.ndarray:
    """UA2 of each sample, in whole samples of a period that is a multiple of the sampling time."""
    period = round(p["cleaning_period"] * DAY / sampling_time)
    days = (sample % period) * sampling_time / DAY
    floor = p["fouling_floor"]
    return np.asarray(6.84 * (floor + (1 - floor) * np.exp(-p["fouling_rate"] * days)))


def run(plant, steps: int, size: float = 60.0) -> np.ndarray:
    rows = [plant.get("UA2_present")[0]]
    for k in range(steps):
        plant.step(k * size, size)
        rows.append(plant.get("UA2_present")[0])
    return np.array(rows)


def test_follows_the_law_over_three_cleanings(plant) -> None:
    plant.initialise(seed=1, **FAST)
    values = run(plant, 220)
    np.testing.assert_allclose(values, law(np.arange(221), FAST), rtol=1e-14)
    assert np.flatnonzero(np.diff(values) > 0).tolist() == [71, 143, 215]


def test_every_cleaning_is_seen_where_the_period_is_not_a_binary_number(plant) -> None:
    """0.3 d of samples of 0.1 d, and of 6.4 s: rounding must not put a cleaning off by a sample."""
    plant.initialise(sampling_time=0.1 * DAY, **(ON | {"cleaning_period": 0.3}))
    values = run(plant, 40, 0.1 * DAY)
    assert np.flatnonzero(values == 6.84).tolist() == list(range(0, 41, 3))


def test_is_held_in_the_sample_whatever_the_communication_step(open_fmu, version: int) -> None:
    coarse, fine = (open_fmu(version).initialise(seed=3, **FAST) for _ in range(2))
    for k in range(100):
        coarse.step(60.0 * k, 60.0)
        before = fine.get("UA2_present")
        for j in range(4):
            assert fine.get("UA2_present") == before
            fine.step(60.0 * k + 15.0 * j, 15.0)
        assert fine.run(0) == coarse.run(0)
    whole = open_fmu(version).initialise(seed=3, **FAST)
    whole.step(0.0, 6000.0)
    assert whole.run(0) == coarse.run(0)


def test_plant_is_the_one_of_that_parameter(open_fmu, version: int) -> None:
    """Sample by sample the fouled plant is a clean one with a smaller UA2."""
    fouled = open_fmu(version).initialise(seed=5, **FAST)
    other = open_fmu(version).initialise(seed=5)
    for k in range(80):
        other.set(UA2=fouled.get("UA2_present")[0])
        fouled.step(60.0 * k, 60.0)
        other.step(60.0 * k, 60.0)
        assert fouled.get("X2", "P2") == other.get("X2", "P2")


def test_model_exchange_changes_it_at_time_events_alone(open_fmu, version: int) -> None:
    model = open_fmu(version, exchange=True).initialise(stochastic=False, **FAST)
    plant = open_fmu(version).initialise(stochastic=False, **FAST)
    for k in range(75):
        assert model.start_continuous_time() == 60.0 * (k + 1)
        model.fmu.setTime(60.0 * (k + 1))
        assert model.get("UA2_present") == plant.get("UA2_present")
        model.fmu.enterEventMode()
        plant.step(60.0 * k, 60.0)
    model.start_continuous_time()
    assert model.get("UA2_present") == plant.get("UA2_present")


def test_derivatives_in_all_that_the_law_names(plant) -> None:
    """Within a sample, before the start, where the sampling time may be moved too."""
    names = ["UA2", *ON, "sampling_time"]
    plant.set(**ON)
    plant.enter_initialisation(start=57.6 * DAY + 30.0)
    unknowns = ["UA2_present", "F5", "der(P2)"]
    for name in names:
        centre, total = plant.get(name)[0], np.zeros(len(unknowns))
        h = 1e-9 * centre if name == "sampling_time" else 1e-6 * centre
        for sign in (1, -1):
            plant.set(**{name: centre + sign * h})
            total += sign * np.array(plant.get(*unknowns)) / (2 * h)
        plant.set(**{name: centre})
        exact = plant.directional(unknowns, [name], [1.0])
        np.testing.assert_allclose(total, exact, rtol=3e-5, err_msg=name)
