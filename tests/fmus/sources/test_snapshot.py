"""State handles and serialised states."""

import itertools
import subprocess
import sys

import numpy as np
import pytest


def stepped(plant, steps: int = 7, **values: float):
    plant.initialise(**values)
    plant.run(steps)
    return plant


def test_restored_instance_continues_bit_identically(open_fmu, version: int) -> None:
    plant = stepped(open_fmu(version), seed=4)
    state = plant.save()
    first = plant.run(10, start=420.0)
    plant.restore(state)
    assert plant.run(10, start=420.0) == first
    plant.free(state)


def test_state_moves_to_another_instance_with_all_its_parameters(open_fmu, version: int) -> None:
    source = stepped(open_fmu(version), seed=4, law=2, M=25.0)
    state = source.save()
    target = open_fmu(version)
    target.restore(state)
    assert target.run(10, start=420.0) == source.run(10, start=420.0)
    source.free(state)


def test_serialised_state_continues_bit_identically_in_another_process(
    open_fmu, version, folders, tmp_path
) -> None:
    plant = stepped(open_fmu(version), seed=4)
    state = plant.save()
    (tmp_path / "state").write_bytes(plant.serialise(state))
    plant.free(state)
    expected = plant.run(10, start=420.0)
    code = f"""
from pathlib import Path
from tests.helpers.instance import Instance
plant = Instance(Path({str(folders[version])!r}), {version})
plant.restore(plant.deserialise(Path({str(tmp_path / "state")!r}).read_bytes()))
print(repr(plant.run(10, start=420.0)))
"""
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stdout.strip() == repr(expected)


@pytest.mark.parametrize("position", ["magic", "version", "value", "checksum", "any"])
def test_flipped_bit_in_a_serialised_state_is_an_error(refused, plant, position: str) -> None:
    plant.initialise()
    state = plant.save()
    data = bytearray(plant.serialise(state))
    plant.free(state)
    offsets = {"magic": [0], "version": [8], "value": [200], "checksum": [len(data) - 1],
               "any": range(0, len(data), 37)}[position]  # fmt: skip
    for offset in offsets:
        data[offset] ^= 0x10
        text = refused(plant, lambda: plant.deserialise(bytes(data)))[1]
        assert "corrupt" in text or "not a state of this FMU" in text
        data[offset] ^= 0x10
    plant.free(plant.deserialise(bytes(data)))


STATES = ("X2", "P2")


def run(plant, points: list[float], **values: float) -> list[float]:
    plant.initialise(start=points[0], seed=3, **values)
    for begin, end in itertools.pairwise(points):
        plant.step(begin, end - begin)
    return plant.get(*STATES, "X1", "economic_cost")


EVEN = [[step * k for k in range(int(600 / step) + 1)] for step in (1.0, 2.0, 30.0, 120.0)]
UNEVEN = [0.0, 7.0, 59.0, 60.0, 61.0, 333.0, 599.0, 600.0]


@pytest.mark.parametrize("points", [*EVEN, UNEVEN], ids=lambda points: f"{len(points)} points")
def test_splits_on_the_grid_are_bit_identical(open_fmu, version: int, points) -> None:
    assert run(open_fmu(version), points) == run(open_fmu(version), [0.0, 600.0])


@pytest.mark.parametrize("step", [0.3, 0.7, 7.3])
def test_splits_off_the_grid_agree_to_the_integration_error(open_fmu, version, step: float) -> None:
    whole = run(open_fmu(version), [0.0, 600.0])
    split = run(open_fmu(version), [*np.arange(0.0, 600.0, step), 600.0])
    np.testing.assert_allclose(split, whole, rtol=1e-9)


def test_accumulated_clock_draws_the_same_disturbances(open_fmu, version: int) -> None:
    """t += 0.1 is off by 1e-10 s after an hour, on either side of the sampling instants."""
    plant = open_fmu(version).initialise(seed=3)
    exact = open_fmu(version).initialise(seed=3)
    time = 0.0
    for k in range(36000):
        if k % 600 == 0:
            assert plant.get("X1") == exact.get("X1")
            exact.step(k / 10, 60.0)
        plant.step(time, 0.1)
        time += 0.1
    assert time != 3600.0
    np.testing.assert_allclose(plant.get(*STATES), exact.get(*STATES), rtol=1e-9)
