"""The exported controller under AddressSanitizer and UBSan, with good and wild states and θ."""

import os
import shutil
import subprocess
from pathlib import Path

import fmpy
import pytest

from controllers.factories import tuned
from cosim import Scenario
from cosim.cli.controller_fmu import sampled_controller
from fmus.build import sources_of

SOAK = Path(__file__).parents[1] / "fmus" / "sampled" / "soak.c"
COMPILER = os.environ.get("CC", "cc")
FLAGS = (
    "-std=c99", "-g", "-O1", "-Wall", "-Wextra", "-Werror",
    "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all",
)  # fmt: skip


@pytest.mark.sanitised
@pytest.mark.parametrize("hessian", ["gauss-newton", pytest.param("exact", marks=pytest.mark.slow)])
def test_nothing_is_allocated_or_broken_while_it_steps(tmp_path: Path, hessian: str) -> None:
    if shutil.which(COMPILER) is None:
        pytest.skip("there is no C compiler")
    scenario = Scenario.load("paper").replace({"controller": {"hessian": hessian}})
    system = sampled_controller(tuned(scenario), scenario)
    for name, data in sources_of(system, 2).items():
        (tmp_path / name).write_bytes(data)
    program, headers = tmp_path / "soak", Path(fmpy.__file__).parent / "c-code"
    folders = ["-isystem", headers, "-I", tmp_path]
    subprocess.run([COMPILER, *FLAGS, *folders, SOAK, "-o", program, "-lm"], check=True)
    result = subprocess.run([program, "20000"], capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    steps, failures, _ = result.stdout.split()
    assert steps == "20000"
    assert 0 < int(failures) < 20000
