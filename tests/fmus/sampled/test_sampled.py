"""The FMU of a sampled system: valid, reproducible, refused where its table is wrong."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import fmpy
import pytest
from fmpy.fmi1 import FMICallException

from fmus.build import build_model, sources_of
from fmus.evaporator import EVAPORATOR
from fmus.model import FmuModel


def test_a_rebuild_repeats_its_bytes(
    built: tuple[int, Path], adder: FmuModel, tmp_path: Path
) -> None:
    again = build_model(adder, tmp_path / "adder.fmu", built[0])
    assert again.read_bytes() == built[1].read_bytes()


FULL_NAME = "#define fmi2FullName(name) name"
STANDARD = """
#define fmi2Paste(a, b) a##b
#define fmi2PasteB(a, b) fmi2Paste(a, b)
#define fmi2FullName(name) fmi2PasteB(FMI2_FUNCTION_PREFIX, name)
"""


def test_sources_of_two_models_link_into_one_program(
    adder: FmuModel, tmp_path: Path, version: int
) -> None:
    """With the standard's headers: fmpy's of FMI 2.0 are changed to ignore the prefix."""
    shutil.copytree(Path(fmpy.__file__).parent / "c-code", tmp_path / "headers")
    functions = tmp_path / "headers" / "fmi2Functions.h"
    text = functions.read_text()
    assert FULL_NAME in text
    functions.write_text(text.replace(FULL_NAME, STANDARD))
    objects = []
    for name, model in (("evaporator", EVAPORATOR), ("adder", adder)):
        folder = tmp_path / name
        folder.mkdir()
        for file, data in sources_of(model, version).items():
            (folder / file).write_bytes(data)
        objects.append(folder / "model.o")
        command = ["cc", "-std=c99", "-Wall", "-Wextra", "-Werror", "-isystem", "headers", "-c"]
        command += [folder / f"fmi{version}.c", "-o", objects[-1]]
        subprocess.run(command, cwd=tmp_path, check=True)
    calls = [f"{name}_fmi{version}GetVersion" for name in ("evaporator", "adder")]
    (tmp_path / "main.c").write_text(
        "".join(f"const char *{call}(void);\n" for call in calls)
        + f"int main(void) {{ return {calls[0]}()[0] != {calls[1]}()[0]; }}\n"
    )
    program = tmp_path / "both"
    subprocess.run(["cc", tmp_path / "main.c", *objects, "-o", program, "-lm"], check=True)
    assert subprocess.run([program], check=False).returncode == 0


def test_a_step_gives_the_sample_that_it_begins_with(make: Callable) -> None:
    fmu = make().initialise()
    found = []
    for k, u in enumerate([1.0, 2.0, 3.0]):
        fmu.set(u=u)
        fmu.step(2.0 * k)
        found += fmu.get("y")
    assert found == [1.0, 3.0, 6.0]


def test_at_a_sample_outputs_follow_inputs_without_a_step(make: Callable) -> None:
    """What masters need that pass outputs on before they step."""
    fmu = make().initialise()
    fmu.step(0.0)
    assert fmu.get("y") == [1.0]
    fmu.set(u=5.0)
    assert fmu.get("y") == [6.0]
    fmu.set(u=4.0)
    assert fmu.get("y") == [5.0]
    fmu.step(2.0)
    assert fmu.get("y") == [5.0]


def test_between_samples_outputs_are_held(make: Callable) -> None:
    fmu = make().initialise()
    for j in range(4):
        fmu.set(u=1.0 + j)
        fmu.step(0.5 * j, 0.5)
        assert fmu.get("y") == [1.0]
    fmu.set(u=7.0)
    fmu.step(2.0, 0.5)
    assert fmu.get("y") == [8.0]


@pytest.mark.parametrize(("time", "size"), [(0.0, 2.5), (0.0, 4.0), (0.5, 2.0)])
def test_a_step_past_a_sample_is_refused(make: Callable, time: float, size: float) -> None:
    fmu = make().initialise()
    if time:
        fmu.step(0.0, time)
    with pytest.raises(FMICallException):
        fmu.step(time, size)
    assert (
        "must end at or before the next multiple of the sampling time, 2 s" in fmu.messages[-1][2]
    )
    fmu.step(time, 2.0 - time)


def test_a_start_between_samples_waits_for_the_next(make: Callable) -> None:
    fmu = make().initialise(-0.5)
    fmu.set(u=3.0)
    fmu.step(-0.5, 0.5)
    assert fmu.get("y") == [1.0]
    fmu.step(0.0)
    assert fmu.get("y") == [3.0]


def test_a_failure_is_a_warning_with_a_reason_and_keeps_the_output(make: Callable) -> None:
    fmu = make().initialise()
    fmu.step(0.0)
    fmu.set(u=-1.0)
    fmu.step(2.0)  # fmpy raises on an error, not on a warning
    assert fmu.get("y") == [1.0]
    assert "no solution at 2 s: the input is negative; the action is held" in fmu.messages[-1][2]
    fmu.step(4.0)
