"""The FMU of a sampled system: valid, reproducible, refused where its table is wrong."""

from __future__ import annotations

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import fmpy
import pytest
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
