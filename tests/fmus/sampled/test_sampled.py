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

from fmus import evaporator
from fmus.model import Kind, Variable
from fmus.sampled import SampledSystem, build_sampled, sampled_sources
from tests.fmus.sampled.conftest import CORE
from tests.helpers.instance import Instance


def test_the_model_description_is_valid(built: tuple[int, Path]) -> None:
    assert validate_fmu(str(built[1])) == []


def test_a_rebuild_repeats_its_bytes(
    built: tuple[int, Path], adder: SampledSystem, tmp_path: Path
) -> None:
    again = build_sampled(adder, tmp_path / "adder.fmu", built[0])
    assert again.read_bytes() == built[1].read_bytes()


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


def test_parameters_are_tunable(make: Callable) -> None:
    fmu = make().initialise()
    fmu.step(0.0)
    fmu.set(**{"theta.gain[0]" if fmu.version == 2 else "theta.gain": 10.0})
    fmu.step(2.0)
    assert fmu.get("y") == [11.0]


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


INTERLEAVED = CORE.replace(
    b"y[0] = s->y;", b"for (int i = 0; i < 4; i++) y[i] = (i % 2 ? -1 : 1) * s->v[i / 2];"
)
INTERLEAVED = INTERLEAVED.replace(b"double sum", b"double v[2], sum").replace(
    b"if (s->status == 0)",
    b"for (int i = 0; i < 2; i++) s->v[i] = gain[i] * u[0];\n    if (s->status == 0)",
)


@pytest.fixture(scope="module")
def arrays(adder: SampledSystem, tmp_path_factory) -> Path:
    """Outputs a[0], b[0], a[1], b[1] with a = -b = u·gain, gain = (2, 3): arrays a, b and gain."""
    outputs = [Variable(f"{name}[{i}]", Kind.OUTPUT) for i in (0, 1) for name in "ab"]
    gains = [Variable(f"gain[{i}]", Kind.TUNABLE, start=2.0 + i) for i in (0, 1)]
    system = replace(
        adder, signals=(adder.signals[0], *outputs, *gains), sources={"core.h": INTERLEAVED}
    )
    folder = tmp_path_factory.mktemp("arrays")
    fmu = build_sampled(system, folder / "arrays.fmu", 3)
    assert validate_fmu(str(fmu)) == []
    fmpy.extract(str(fmu), str(folder / "unzipped"))
    return folder / "unzipped"


def test_fmi_3_has_arrays(arrays: Path) -> None:
    fmu = Instance(arrays, 3).initialise()
    assert list(fmu.variables) == ["time", "u", "a", "b", "gain"]
    a, b, gains, u = (fmu.reference(name) for name in ("a", "b", "gain", "u"))
    assert fmu.fmu.getFloat64([gains, a, u, b], 7) == [2.0, 3.0, 2.0, 3.0, 1.0, -2.0, -3.0]
    fmu.fmu.setFloat64([u, gains], [10.0, 5.0, 7.0])
    assert fmu.fmu.getFloat64([b, a], 4) == [-50.0, -70.0, 50.0, 70.0]
    for references, values in (
        ([gains], [1.0]),
        ([gains], [1.0, 2.0, 3.0]),
        ([gains, u], [8.0, 9.0, math.nan, 1.0]),
        ([gains, u], [8.0, 9.0, 11.0]),  # u is at most 10: no gain may change either
        ([gains + 1], [1.0]),
        ([a], [1.0, 1.0]),
    ):
        with pytest.raises(FMICallException):
            fmu.fmu.setFloat64(references, values)
        assert fmu.fmu.getFloat64([gains, u], 3) == [5.0, 7.0, 10.0]
    for references, count in (([a], 1), ([a], 3), ([a + 2], 1), ([99], 1), ([], 2)):
        with pytest.raises(FMICallException):
            fmu.fmu.getFloat64(references, count)
    with pytest.raises(FMICallException):
        fmu.fmu.getBoolean([a], 2)
    fmu.close()
