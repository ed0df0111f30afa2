"""The co-simulation step: its arguments, the stop time, and instances beside each other."""

import math
from itertools import accumulate

import pytest

DISCARD, ERROR = 2, 3


WRONG_STEPS = [(0.0, size, "step size") for size in (0.0, -1.0, math.nan, math.inf)]
WRONG_STEPS += [(t, 60.0, "communication point") for t in (60.0, -60.0, 1e-3, math.nan, math.inf)]


@pytest.mark.parametrize(("time", "size", "words"), WRONG_STEPS)
def test_a_step_begins_now_and_is_positive_and_finite(refused, plant, time, size, words) -> None:
    plant.initialise()
    status, text = refused(plant, lambda: plant.step(time, size))
    assert status == ERROR
    assert words in text


def test_step_past_the_stop_time_is_an_error_and_changes_nothing(refused, plant) -> None:
    plant.initialise(stop=100.0)
    plant.step(0.0, 60.0)
    before = plant.run(0)
    status, text = refused(plant, lambda: plant.step(60.0, 60.0))
    assert status == ERROR
    assert "past the stop time 100" in text
    assert plant.run(0) == before
    plant.step(60.0, 40.0)


def test_step_of_too_many_integration_steps_is_discarded_at_once(refused, plant) -> None:
    plant.initialise()
    status, text = refused(plant, lambda: plant.step(0.0, 1e9))
    assert status == DISCARD
    assert "integration steps" in text
    plant.step(0.0, 86400.0)


@pytest.fixture
def telling(open_fmu):
    """An FMI 3.0 instance, and what it tells of its steps: time, states, and what was refused."""
    told = []

    def update(_, time: float, *__) -> None:
        status = instance.fmu.dll.fmi3Terminate(instance.handle)
        told.append((time, *instance.get("X2", "P2"), status))
        instance.messages.clear()

    instance = open_fmu(3, intermediateUpdate=update, requiredIntermediateVariables=[1, 2])
    return instance, told


@pytest.mark.parametrize("sizes", [[60.0] * 3, [90.3, 0.2, 0.5, 600.0]])
def test_a_step_that_tells_of_the_values_inside_computes_the_same(open_fmu, telling, sizes) -> None:
    quiet, (instance, told) = open_fmu(3), telling
    ends = [0.0, *accumulate(sizes)]
    for each in (quiet, instance):
        each.initialise(seed=3)
    for time, size in zip(ends, sizes, strict=False):
        quiet.step(time, size)
        instance.step(time, size)
        assert instance.run(0) == quiet.run(0)
        assert told[-1] == (time + size, *quiet.get("X2", "P2"), ERROR)
    inside = map(float, range(1, int(ends[-1]) + 1))
    assert [time for time, *_ in told] == sorted({*inside, *ends[1:]})


def test_parameters_that_make_the_plant_too_fast_are_an_error(refused, plant, telling) -> None:
    """All in range, but with a time constant of some microseconds."""
    for instance in (plant, telling[0]):
        instance.initialise(h=10.0, F3=1000.0, lambda_=1.0, C=0.1, M=1.0)
        before = instance.run(0)
        status, text = refused(instance, lambda each=instance: each.step(0.0, 600.0))
        assert status == ERROR
        assert "the states change too fast between 0 s and" in text
        assert instance.run(0) == before
