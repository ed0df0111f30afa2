"""Foreign FMUs of many kinds and of both FMI versions, from one C source and a described kind."""

import re
import subprocess
import zipfile
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import fmpy

from cosim import Scenario
from fmus import present
from tests.helpers.tank import write_one_state

SOURCES = Path(__file__).parent / "foreign"
REALS = """
u     0  input      -        0
x     1  output     -        -
cost  2  output     -        -
x_start 3 parameter fixed    1
range 4  parameter  fixed    0
"""


@cache
def library(version, source="kinds"):
    """A compiled source with a refusing stub for each function that it lacks, as bytes."""
    folder = Path(mkdtemp())
    headers = Path(fmpy.__file__).parent / "c-code"
    functions = re.findall(
        rf"FMI{version}_Export \w+TYPE\s+(\w+);", (headers / f"fmi{version}Functions.h").read_text()
    )
    text = (SOURCES / f"{source}.c").read_text()
    own = text.split("#if VERSION == 2")[1].split("#else")[version - 2]
    stubs = [f"int {name}(void) {{ return 3; }}" for name in functions if f"{name}(" not in own]
    (folder / "kinds.c").write_text(text + "\n".join(stubs) + "\n")
    command = ["cc", "-shared", "-fPIC", "-O1", "-w", f"-DVERSION={version}", f"-I{headers}"]
    subprocess.run([*command, "kinds.c", "-o", "kinds.so"], cwd=folder, check=True)
    return (folder / "kinds.so").read_bytes()


def variables(version, *, reals=REALS, more=""):
    """The element ModelVariables."""
    rows = [line.split() for line in reals.strip().splitlines()]
    integers = [("seed", 0 if version == 2 else 20), ("fault", 1 if version == 2 else 21)]
    parts = ['<Float64 name="time" valueReference="99" causality="independent"/>'] * (version - 2)
    for name, vr, causality, variability, start in rows:
        common = f'name="{name}" valueReference="{vr}" causality="{causality}"'
        common += "" if variability == "-" else f' variability="{variability}"'
        value = "" if start == "-" else f'start="{start}"'
        parts.append(
            f"<ScalarVariable {common}><Real {value}/></ScalarVariable>"
            if version == 2
            else f"<Float64 {common} {value}/>"
        )
    for name, vr in integers:
        common = f'name="{name}" valueReference="{vr}" causality="parameter" variability="fixed"'
        parts.append(
            f'<ScalarVariable {common}><Integer start="0"/></ScalarVariable>'
            if version == 2
            else f'<Int32 {common} start="0"/>'
        )
    return f"<ModelVariables>{''.join(parts)}{more}</ModelVariables>"


def structure(version, reals=REALS):
    names = [line.split() for line in reals.strip().splitlines()]
    outputs = [(i + 1, row[1]) for i, row in enumerate(names) if row[2] == "output"]
    if version == 3:
        tags = [f'<{tag} valueReference="{vr}"/>' for tag in ("Output", "InitialUnknown")
                for _, vr in outputs]  # fmt: skip
        return f"<ModelStructure>{''.join(tags)}</ModelStructure>"
    unknowns = "".join(f'<Unknown index="{i}"/>' for i, _ in outputs)
    return (
        f"<ModelStructure><Outputs>{unknowns}</Outputs>"
        f"<InitialUnknowns>{unknowns}</InitialUnknowns></ModelStructure>"
    )


def build_kind(
    folder,
    version,
    *,
    face='CoSimulation modelIdentifier="kinds" canHandleVariableCommunicationStepSize="true"',
    experiment="",
    reals=REALS,
    more="",
    separator="/",
    data=None,
    source="kinds",
):
    """Write an FMU whose description differs from the plain kind's as told; return its path."""
    token = "guid" if version == 2 else "instantiationToken"
    text = (
        f'<fmiModelDescription fmiVersion="{version}.0" modelName="kinds" {token}="{{kinds}}">'
        f"<{face}/>{experiment}{variables(version, reals=reals, more=more)}"
        f"{structure(version, reals)}</fmiModelDescription>"
    )
    target = folder / f"kind{version}.fmu"
    entry = separator.join(["binaries", present().folder(f"{version}.0"), "kinds.so"])
    with zipfile.ZipFile(target, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        archive.writestr(entry, library(version, source) if data is None else data)
        archive.writestr(separator.join(["resources", "readme.txt"]), b"nothing")
    return target


def scenario_for(folder, fmu, *, sampling_time=0.5, fault=0, parameters=""):
    """Write a scenario for a kind; return its path."""
    plant = f"parameters = {{ fault = {fault}{parameters} }}\n"
    plant += 'mapping = { initial_state = ["x_start"], seed = ["seed"] }'
    return write_one_state(folder / "kind.toml", fmu, plant, sampling_time)


HABIT_REALS = """
u       0  input      -        0
x       1  output     -        -
cost    2  output     -        -
d       3  output     -        -
x_start 4  parameter  fixed    1
key     6  parameter  tunable  0
enable  7  input      -        0
"""


def build_habits(folder, version=2, *, experiment="", once=False):
    """Write the FMU of `foreign/habits.c`; return its path."""
    face = 'CoSimulation modelIdentifier="kinds" canHandleVariableCommunicationStepSize="true" '
    face += f'canGetAndSetFMU{"state" if version == 2 else "State"}="true"'
    face += ' canBeInstantiatedOnlyOncePerProcess="true"' if once else ""
    return build_kind(
        folder, version, face=face, experiment=experiment, reals=HABIT_REALS, source="habits"
    )


def habit_scenario(folder, fmu, habits=0, **plant):
    """A scenario for that FMU with a sum of habits, and further fields of its table [plant]."""
    lines = f'disturbances = ["d"]\nparameters = {{ fault = {habits} }}\n'
    lines += 'mapping = { initial_state = ["x_start"] }'
    path = write_one_state(folder / "habits.toml", fmu, lines)
    return Scenario.load(path).replace({"plant": plant})
