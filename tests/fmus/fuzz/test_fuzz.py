"""Both faces of every plant under AddressSanitizer and UBSan: random calls in random order."""

import os
import shutil
import subprocess
from pathlib import Path

import fmpy
import pytest

from fmus import plant as plants
from fmus.build import sources_of
from fmus.evaporator import EVAPORATOR
from fmus.model import FmiVersion
from fmus.plant import build_plant

HERE = Path(__file__).parent
COMPILER = os.environ.get("CC", "cc")
FLAGS = (
    "-std=c99", "-g", "-O1", "-Wall", "-Wextra", "-Werror", "-Wno-cast-function-type",
    "-Wno-unused-function",
    "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all",
    "-fno-omit-frame-pointer", "-DFMI2_OVERRIDE_FUNCTION_PREFIX", "-DFMI3_OVERRIDE_FUNCTION_PREFIX",
)  # fmt: skip
CALLS = 300_000
SECONDS = 60
SEEDS = {"evaporator": 3} | dict.fromkeys(plants.SHIPPED_PLANTS, 1)

pytestmark = pytest.mark.sanitised


def written(name: str, version: FmiVersion, folder: Path) -> Path:
    """The folder with the C sources that the FMU of a plant carries."""
    if name == "evaporator":
        for file, data in sources_of(EVAPORATOR, version).items():
            (folder / file).write_bytes(data)
        return folder
    fmu = folder / f"{name}.fmu"
    build_plant(plants.model(name), plants.equations(name), fmu, version)
    return Path(fmpy.extract(str(fmu), folder / "fmu")) / "sources"


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.slow if name == "evaporator" else ()) for name in SEEDS],
)
def test_random_calls_break_nothing(tmp_path: Path, name: str, version: FmiVersion) -> None:
    """No sanitizer report, every refusal logged, and a refused call changes nothing."""
    if shutil.which(COMPILER) is None:
        pytest.skip("there is no C compiler")
    headers = Path(fmpy.__file__).parent / "c-code"
    program = tmp_path / "fuzz"
    subprocess.run(
        [COMPILER, *FLAGS, "-isystem", headers, "-I", written(name, version, tmp_path),
         HERE / f"fuzz_fmi{version}.c", "-o", program, "-lm"],
        check=True,
    )  # fmt: skip
    for seed in range(1, SEEDS[name] + 1):
        command = [program, str(seed), str(CALLS), str(SECONDS)]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr
        assert int(result.stdout.split()[0]) > CALLS // 100
