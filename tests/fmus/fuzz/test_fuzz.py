"""Both faces under AddressSanitizer and UBSan, with random calls in random order."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import fmpy
import pytest

from fmus.build import SOURCES

HERE = Path(__file__).parent
COMPILER = os.environ.get("CC", "cc")
FLAGS = (
    "-std=c99", "-g", "-O1", "-Wall", "-Wextra", "-Werror", "-Wno-cast-function-type",
    "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all",
    "-fno-omit-frame-pointer", "-DFMI2_OVERRIDE_FUNCTION_PREFIX", "-DFMI3_OVERRIDE_FUNCTION_PREFIX",
)  # fmt: skip
CALLS = 300_000
SECONDS = 60


@pytest.fixture(scope="module", params=[2, 3], ids=["fmi2", "fmi3"])
def fuzzer(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which(COMPILER) is None:
        pytest.skip("there is no C compiler")
    program = tmp_path_factory.mktemp("fuzz") / f"fuzz_fmi{request.param}"
    headers = Path(fmpy.__file__).parent / "c-code"
    subprocess.run(
        [COMPILER, *FLAGS, "-isystem", headers, "-I", SOURCES,
         HERE / f"fuzz_fmi{request.param}.c", "-o", program, "-lm"],
        check=True,
    )  # fmt: skip
    return program


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_random_calls_break_nothing(fuzzer: Path, seed: int) -> None:
    """No sanitizer report, every refusal logged, and a refused call changes nothing."""
    command = [str(fuzzer), str(seed), str(CALLS), str(SECONDS)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert int(result.stdout.split()[0]) > CALLS // 100
