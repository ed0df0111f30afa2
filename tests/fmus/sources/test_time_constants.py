"""Disturbances with a time constant: their draws filtered, the value a part of the state."""

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException

NAMES = ("X1", "F1", "T1", "T200")
NOMINAL = np.array([5.0, 10.0, 40.0, 25.0])
RANGE = np.array([1.0, 2.0, 8.0, 5.0])
TIME_CONSTANTS = np.array([120.0, 300.0, 0.0, 6000.0])
COLOURED = {f"{name}_time_constant": T for name, T in zip(NAMES, TIME_CONSTANTS, strict=True)}


def deviations(plant, samples: int, start: float = 0.0) -> np.ndarray:
    """Deviations (samples, 4) in ranges, at the start of each sample."""
    rows = []
    for k in range(samples):
        rows.append(plant.get(*NAMES))
        plant.step(start + 60.0 * k, 60.0)
    return (np.array(rows) - NOMINAL) / RANGE


def filtered(draws: np.ndarray) -> np.ndarray:
    """x_k = φ x_{k−1} + √(1 − φ²) w_k from x = w."""
    phi = np.exp(-60.0 / np.maximum(TIME_CONSTANTS, 1e-3))
    rows = [draws[0]]
    for w in draws[1:]:
        rows.append(phi * rows[-1] + np.sqrt(1 - phi**2) * w)
    return np.array(rows)


@pytest.mark.parametrize("law", [1, 2])
def test_the_value_is_the_draws_filtered(open_fmu, version: int, law: int) -> None:
    white = deviations(open_fmu(version).initialise(seed=3, law=law), 50)
    coloured = deviations(open_fmu(version).initialise(seed=3, law=law, **COLOURED), 50)
    np.testing.assert_allclose(coloured, filtered(white), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(coloured[:, 2], white[:, 2])


def test_both_versions_of_fmi_give_the_same_bits(open_fmu) -> None:
    two = open_fmu(2).initialise(seed=3, law=2, **COLOURED)
    three = open_fmu(3).initialise(seed=3, law=2, **COLOURED)
    assert two.run(30) == three.run(30)


def test_a_later_start_begins_anew(open_fmu, version: int) -> None:
    white = deviations(open_fmu(version).initialise(start=600.0, seed=3), 20, 600.0)
    coloured = deviations(open_fmu(version).initialise(start=600.0, seed=3, **COLOURED), 20, 600.0)
    np.testing.assert_allclose(coloured, filtered(white), rtol=0, atol=1e-12)


@pytest.mark.parametrize("step", [1.0, 30.0, 120.0, 600.0])
def test_steps_over_no_draw_and_over_many_give_the_same_bits(open_fmu, version, step) -> None:
    plant = open_fmu(version).initialise(seed=3, **COLOURED)
    once = open_fmu(version).initialise(seed=3, **COLOURED)
    for k in range(round(1200 / step)):
        plant.step(k * step, step)
    once.step(0.0, 1200.0)
    assert plant.run(0) == once.run(0)


def test_the_filter_goes_on_while_its_value_is_not_used(open_fmu, version: int) -> None:
    plant = open_fmu(version).initialise(seed=3, stochastic=False, **COLOURED)
    always = open_fmu(version).initialise(seed=3, **COLOURED)
    assert plant.get(*NAMES) == list(NOMINAL)
    plant.step(0.0, 600.0)
    always.step(0.0, 600.0)
    plant.set(stochastic=True)
    assert plant.get(*NAMES) == always.get(*NAMES)


@pytest.mark.parametrize("part_of_a_sample", [0.0, 30.0])
def test_a_saved_and_a_serialised_state_hold_the_value(
    open_fmu, version, part_of_a_sample: float
) -> None:
    plant = open_fmu(version).initialise(seed=4, law=2, **COLOURED)
    now = 420.0 + part_of_a_sample
    plant.step(0.0, now)
    state = plant.save()
    data = plant.serialise(state)
    first = plant.run(10, start=now)
    plant.restore(state)
    plant.free(state)
    assert plant.run(10, start=now) == first
    other = open_fmu(version).initialise()
    other.restore(other.deserialise(data))
    assert other.run(10, start=now) == first


def test_a_reset_forgets_the_value(open_fmu, version: int) -> None:
    plant = open_fmu(version).initialise(seed=4, **COLOURED)
    first = plant.run(10)
    plant.fmu.reset()
    plant.initialise(seed=4, **COLOURED)
    assert plant.run(10) == first
    plant.fmu.reset()
    assert plant.initialise(seed=4).run(10) == open_fmu(version).initialise(seed=4).run(10)


def test_model_exchange_draws_the_same_and_does_not_go_back(open_fmu, version: int) -> None:
    plant = open_fmu(version).initialise(seed=8, **COLOURED)
    model = open_fmu(version, exchange=True).initialise(seed=8, **COLOURED)
    present = 0
    # One event is late: it passes over two samples.
    for sample in (0, 1, 2, 5, 6):
        model.fmu.setTime(60.0 * sample)
        assert model.start_continuous_time() == 60.0 * (sample + 1)
        for k in range(present, sample):
            plant.step(60.0 * k, 60.0)
        present = sample
        assert model.get(*NAMES) == plant.get(*NAMES)
        model.fmu.enterEventMode()
    model.fmu.setTime(60.0)
    with pytest.raises(FMICallException):
        model.start_continuous_time()
    assert "go forwards from sample 6" in model.messages[-1][2]
