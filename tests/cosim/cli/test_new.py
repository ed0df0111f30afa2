"""What `cosim new` writes is what a page shows, and runs by the commands that it prints."""

import os
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

from tests.helpers.code_blocks import ROOT
from tests.helpers.compiler import needs_compiler

PAGES = {
    "rule": ("capped_td", "algorithm.md"),
    "controller": ("proportional", "python.md"),
    "plant": ("heater", "your-plant.md"),
    "study": ("mine", "study.md"),
}


@pytest.mark.parametrize("kind", PAGES)
def test_a_skeleton_is_what_its_page_shows_and_is_written_once(kind, cosim, tmp_path):
    name, page = PAGES[kind]
    assert cosim("new", kind, name)[0] == 0
    text = (ROOT / "docs" / "how-to" / page).read_text("utf-8")
    files = list(tmp_path.iterdir())
    shown = [f'title="{path.name}"\n{path.read_text("utf-8")}```' in text for path in files]
    assert all(shown)
    files[-1].write_text("mine")
    for path in files[:-1]:
        path.unlink()
    code, _, err = cosim("new", kind, name)
    assert (code, err.count("\n"), files[-1].read_text()) == (2, 1, "mine")
    assert list(tmp_path.iterdir()) == files[-1:]


def test_the_command_that_is_printed_for_a_study_is_the_one_that_its_page_types(cosim):
    said = cosim("new", "study", "mine")[2]
    command = "cosim study run mine.toml --out "
    assert said.endswith(f"next:\n{command}mine-run\n")
    assert f"\n$ {command}study" in (ROOT / "docs" / "how-to" / "study.md").read_text("utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [kind for kind in PAGES if kind != "study"])
def test_a_skeleton_runs_by_the_commands_that_are_printed(kind, cosim, tmp_path):
    said = cosim("new", kind, "my_own", "--out", "a folder")[2]
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    script = "set -e\n" + said.partition("next:\n")[2]
    env = os.environ | {"PATH": path}
    subprocess.run(script, shell=True, cwd=tmp_path, env=env, check=True)
    assert (tmp_path / "a folder" / "my_own-run" / "summary.json").is_file()


@pytest.mark.slow
@needs_compiler
def test_a_new_plant_runs_behind_the_sensors_that_are_proposed_and_with_a_signal(cosim, tmp_path):
    """The drafted sensors without their #, an analyser among them, and a bound that moves."""
    cosim("new", "plant", "mine", "--out", str(tmp_path))
    subprocess.run([sys.executable, "mine.py"], cwd=tmp_path, check=True)
    scenario = tmp_path / "mine.toml"
    env = os.environ | {"PYTHONPATH": str(tmp_path)}
    command = [sys.executable, "-m", "cosim"]
    init = ["scenario", "init", "mine.fmu", "--model", "mine:model", "--out", str(scenario)]
    subprocess.run([*command, *init], cwd=tmp_path, env=env, check=True)
    text, mark, proposed = scenario.read_text("utf-8").partition("# [[sensor]]")
    assert mark
    tables = (mark + proposed).replace("# ", "", 1).replace("\n# ", "\n")
    slow = tables.replace('variable = "m"\n', 'variable = "m"\nevery = 15\n')
    signal = (
        '\n[[signal]]\nname = "least"\nvalues = [60.0, 65.0]\nperiod = 1200.0\n'
        'bound = "x_l[T]"\nknown = "preview"\n'
    )
    scenario.write_text(text + slow + signal, "utf-8")
    run = ["simulate", "-s", str(scenario), "-c", "tuned", "--steps", "60", "--out", "run"]
    subprocess.run([*command, *run], cwd=tmp_path, env=env, check=True)
    table = pd.read_csv(tmp_path / "run" / "trajectory.csv", comment="#")
    column = {name.partition(" ")[0]: name for name in table.columns}
    readings = table[column["measured[m]"]]
    assert list(readings.index[readings.notna()]) == [0, 15, 30, 45]
    assert table[column["estimated[m]"]].notna().all()
    assert sorted(table[column["signal[least]"]].unique()) == [60.0, 65.0]
