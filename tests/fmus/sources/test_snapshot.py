"""State handles and serialised states."""

from __future__ import annotations

import subprocess
import sys

import pytest

ERROR = 3


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
import importlib.util, pathlib, sys
spec = importlib.util.spec_from_file_location("adapter", {__file__!r}.replace(
    "sources/test_snapshot.py", "conftest.py"))
adapter = importlib.util.module_from_spec(spec)
sys.modules["adapter"] = adapter
spec.loader.exec_module(adapter)
plant = adapter.Instance(pathlib.Path({str(folders[version])!r}), {version}, False)
plant.restore(plant.deserialise(pathlib.Path({str(tmp_path / "state")!r}).read_bytes()))
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


def test_state_of_one_fmi_version_continues_in_the_other(open_fmu) -> None:
    two, three = stepped(open_fmu(2), seed=4), open_fmu(3)
    state = two.save()
    copy = three.deserialise(two.serialise(state))
    three.restore(copy)
    assert three.run(10, start=420.0) == two.run(10, start=420.0)
    two.free(state)
    three.free(copy)
