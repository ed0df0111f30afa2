"""Builds FMUs that are not ours: a tank from C, and ours with parts of them changed."""

import subprocess
import zipfile
from pathlib import Path

import fmpy

SOURCE = Path(__file__).parent / "foreign" / "tank.c"
DESCRIPTION = SOURCE.with_suffix(".xml")


SCENARIO = """
schema = 1
name = "{name}"
sampling_time = {sampling_time}
discount = 0.95
[plant]
fmu = "{fmu}"
states = ["x"]
actions = ["u"]
stage_cost = "cost"
initial_state = [1.0]
{plant}
[bounds]
state_lower = [0.0]
state_upper = [inf]
action_lower = [0.0]
action_upper = [3.0]
[penalty]
linear = [10.0]
quadratic = [1.0]
[controller]
reference_state = [1.0]
reference_action = [1.0]
reference_cost = 1.0
"""


def write_one_state(path, fmu, plant, sampling_time=0.5):
    """Write the scenario of an FMU, with more lines for its table [plant]; return its path."""
    path.write_text(
        SCENARIO.format(name=path.stem, sampling_time=sampling_time, fmu=fmu, plant=plant)
    )
    return path


def build_tank(folder, saves):
    """Compile the tank into an FMU of its own."""
    library = folder / "tank.so"
    headers = Path(fmpy.__file__).parent / "c-code"
    compiler = ["cc", "-shared", "-fPIC", "-O1", f"-I{headers}", "-o", str(library)]
    flags = ["-DHAS_STATE"] if saves else []
    subprocess.run([*compiler, *flags, str(SOURCE), "-lm"], check=True)
    target = folder / f"tank_{'with' if saves else 'without'}_state.fmu"
    with zipfile.ZipFile(target, "w") as archive:
        text = DESCRIPTION.read_text()
        if saves:
            text = text.replace('canGetAndSetFMUstate="false"', 'canGetAndSetFMUstate="true"')
        archive.writestr("modelDescription.xml", text)
        archive.write(library, f"binaries/{fmpy.platform}/tank.so")
    return target


def write_scenario(folder, fmu, fault=0, mapped=True):
    """Write a scenario for the tank."""
    mapping = 'mapping = { initial_state = ["x_start"] }' if mapped else ""
    plant = f"parameters = {{ tau = 4.0, fault = {fault} }}\n{mapping}"
    return write_one_state(folder / "tank.toml", fmu, plant)


def edited(source, target, change):
    """Copy an FMU with its model description changed by a function of its text."""
    with zipfile.ZipFile(source) as old, zipfile.ZipFile(target, "w") as new:
        for entry in old.infolist():
            data = old.read(entry)
            if entry.filename == "modelDescription.xml":
                data = change(data.decode()).encode()
            new.writestr(entry.filename, data)
    return target
