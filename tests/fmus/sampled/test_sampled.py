"""The FMU of a sampled system: valid, reproducible, refused where its table is wrong."""

import math
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import fmpy
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

from fmus import BuildError, evaporator
from fmus.sampled import SampledSystem, build_sampled, sampled_sources


def test_the_model_description_is_valid(built: tuple[int, Path]) -> None:
    assert validate_fmu(str(built[1])) == []


def test_it_is_for_co_simulation_alone_with_tunable_parameters(built: tuple[int, Path]) -> None:
    found = fmpy.read_model_description(str(built[1]))
    assert found.modelExchange is None
    assert float(found.defaultExperiment.stepSize) == 2.0
    variables = {v.name: v for v in found.modelVariables}
    assert (variables["u"].causality, variables["u"].unit) == ("input", "kPa")
    assert (variables["y"].causality, variables["y"].variability) == ("output", "discrete")
    gain = variables["theta.gain[0]"]
    assert (gain.causality, gain.variability, gain.start) == ("parameter", "tunable", "1.0")


def test_a_rebuild_repeats_its_bytes(
    built: tuple[int, Path], adder: SampledSystem, tmp_path: Path
) -> None:
    again = build_sampled(adder, tmp_path / "adder.fmu", built[0])
    assert again.read_bytes() == built[1].read_bytes()


def test_a_name_taken_twice_is_refused(adder: SampledSystem) -> None:
    with pytest.raises(BuildError, match="two variables of adder are called 'u'"):
        replace(adder, signals=(*adder.signals, adder.signals[0]))


FULL_NAME = "#define fmi2FullName(name) name"
STANDARD = """
#define fmi2Paste(a, b) a##b
#define fmi2PasteB(a, b) fmi2Paste(a, b)
#define fmi2FullName(name) fmi2PasteB(FMI2_FUNCTION_PREFIX, name)
"""


def test_sources_of_two_models_link_into_one_program(
    adder: SampledSystem, tmp_path: Path, version: int
) -> None:
    """With the standard's headers: fmpy's of FMI 2.0 are changed to ignore the prefix."""
    shutil.copytree(Path(fmpy.__file__).parent / "c-code", tmp_path / "headers")
    functions = tmp_path / "headers" / "fmi2Functions.h"
    text = functions.read_text()
    assert FULL_NAME in text
    functions.write_text(text.replace(FULL_NAME, STANDARD))
    objects = []
    for name, files in (
        ("evaporator", evaporator.sources(version)),
        ("adder", sampled_sources(adder, version)),
    ):
        folder = tmp_path / name
        folder.mkdir()
        for file, data in files.items():
            (folder / file).write_bytes(data)
        objects.append(folder / "model.o")
        command = ["cc", "-std=c99", "-w", "-isystem", tmp_path / "headers", "-c"]
        subprocess.run([*command, folder / f"fmi{version}.c", "-o", objects[-1]], check=True)
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


def test_inputs_that_do_not_change_count_again(make: Callable) -> None:
    fmu = make().initialise()
    for k in range(3):
        fmu.step(2.0 * k)
    assert fmu.get("y") == [3.0]


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


def test_parameters_are_tunable(make: Callable) -> None:
    fmu = make().initialise()
    fmu.step(0.0)
    fmu.set(**{"theta.gain[0]": 10.0})
    fmu.step(2.0)
    assert fmu.get("y") == [11.0]


def test_a_value_out_of_range_is_refused(make: Callable) -> None:
    fmu = make().initialise()
    with pytest.raises(FMICallException):
        fmu.set(u=11.0)
    with pytest.raises(FMICallException):
        fmu.set(**{"theta.gain[0]": float("nan")})


def test_a_snapshot_repeats_what_follows_also_as_bytes_in_another_instance(make: Callable) -> None:
    fmu, other = make().initialise(), make().initialise()
    fmu.step(0.0)
    fmu.set(u=2.0)
    state = fmu.save()
    data = fmu.serialise(state)

    def rest(instance) -> list[float]:
        found = instance.get("y")
        for k in (1, 2):
            instance.step(2.0 * k)
            found += instance.get("y")
        return found

    expected = rest(fmu)
    fmu.restore(state)
    assert rest(fmu) == expected
    other.restore(other.deserialise(data))
    assert rest(other) == expected


def test_held_outputs_survive_a_snapshot(make: Callable) -> None:
    fmu, other = make().initialise(), make().initialise()
    fmu.set(u=4.0)
    fmu.step(0.0)
    other.restore(other.deserialise(fmu.serialise(fmu.save())))
    assert other.get("y") == fmu.get("y") == [4.0]


def test_damaged_bytes_are_refused(make: Callable) -> None:
    fmu = make().initialise()
    data = bytearray(fmu.serialise(fmu.save()))
    data[len(data) // 2] ^= 1
    with pytest.raises(FMICallException):
        fmu.deserialise(bytes(data))


def test_an_input_that_is_not_finite_reaches_the_core_and_the_state_can_still_be_saved(
    make: Callable,
) -> None:
    """A sensor fails while the loop goes on; what to do is the controller's to decide."""
    fmu, other = make().initialise(), make().initialise()
    fmu.set(u=math.nan)
    fmu.step(0.0)
    assert math.isnan(fmu.get("u")[0])
    other.restore(other.deserialise(fmu.serialise(fmu.save())))
    assert math.isnan(other.get("u")[0])
    fmu.set(u=math.inf)
    assert math.isnan(fmu.get("u")[0])
