import zipfile
from pathlib import Path

import fmpy
import numpy as np
import pytest
from scipy.linalg import expm

from cosim import FmuPlant
from cosim.core.errors import PlantError
from fmus import PLATFORMS, BuildError, present
from fmus.build import build_folder
from fmus.plant import Signal, build_plant, plant_model
from tests.helpers.compiler import needs_compiler
from tests.helpers.platforms import CROSS
from tests.helpers.tank import write_one_state

pytestmark = needs_compiler
EQUATIONS = """
#pragma once
#include "variables.h"
static void evaluate(double v[N_VARIABLES]) {
    v[VR_der_x] = v[VR_gain] * v[VR_u] - v[VR_x];
    v[VR_y] = 2.0 * v[VR_x];
}
"""


def model(disturbances: int = 0):
    names = [f"d{i}" for i in range(disturbances)]
    return plant_model(
        "lag",
        states=[Signal("x", "m", 1.0, -10.0, 10.0, "level")],
        inputs=[Signal("u", "m", 0.0, -10.0, 10.0, "inflow")],
        disturbances=[Signal(name, "m", 0.5, -9.0, 9.0, "noise", 0.25) for name in names],
        outputs=[Signal("y", "m", 2.0, -20.0, 20.0, "twice the level")],
        parameters=[Signal("gain", "1", 1.0, 0.0, 10.0, "gain")],
        sampling_time=0.5,
    )


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("disturbances", [0, 3])
def test_any_number_of_disturbances(tmp_path: Path, version, disturbances: int) -> None:
    """The step response is exact; draws of odd numbers fit."""
    fmu = build_plant(model(disturbances), EQUATIONS, tmp_path / "lag.fmu", version)
    names = [f"d{i}" for i in range(disturbances)]
    result = fmpy.simulate_fmu(
        str(fmu), stop_time=5.0, output_interval=0.5, output=["x", "y", *names],
        start_values={"u": 3.0, "seed": 4}, fmi_type="CoSimulation",
    )  # fmt: skip
    exact = 3.0 - 2.0 * np.exp(-result["time"])
    np.testing.assert_allclose(result["x"], exact, rtol=1e-6)
    np.testing.assert_array_equal(result["y"], 2.0 * result["x"])
    for name in names:
        assert np.all(np.abs(result[name] - 0.5) <= 0.25)
        assert len(set(result[name])) == 11


def linear_system(rates: np.ndarray):
    """Table and equations of x' = rates x, sampled each second."""
    n = len(rates)
    table = plant_model(
        "linear",
        states=[Signal(f"x{i}", "m", 1.0, description="state") for i in range(n)],
        inputs=[Signal("u", "m", 0.0, -1.0, 1.0, "nothing")],
        disturbances=[],
        outputs=[Signal("y", "m", description="first state")],
        sampling_time=1.0,
    )
    lines = ["#pragma once", '#include "variables.h"', "static void evaluate(double *v) {"]
    for i, row in enumerate(rates):
        terms = [f"{rate!r} * v[VR_x{j}]" for j, rate in enumerate(row.tolist())]
        lines.append(f"    v[VR_der_x{i}] = {' + '.join(terms)};")
    lines.append("    v[VR_y] = v[VR_x0];\n}")
    return table, "\n".join(lines)


@pytest.mark.parametrize("seed", range(6))
def test_a_plant_of_any_speed_is_integrated_to_its_flow(tmp_path: Path, seed: int) -> None:
    """Modes from 0.1/s to 1000/s, sampled each second, beside the matrix exponential."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    basis = rng.normal(size=(n, n)) + 2.0 * np.eye(n)
    modes = -(10.0 ** rng.uniform(-1.0, 3.0, n))
    rates = basis @ np.diag(modes) @ np.linalg.inv(basis)
    fmu = build_plant(*linear_system(rates), tmp_path / "linear.fmu", 2 + seed % 2)
    states = [f"x{i}" for i in range(n)]
    result = fmpy.simulate_fmu(
        str(fmu), stop_time=4.0, output_interval=0.8, output=states, fmi_type="CoSimulation",
    )  # fmt: skip
    for row in result:
        exact = expm(rates * row["time"]) @ np.ones(n)
        computed = [row[name] for name in states]
        np.testing.assert_allclose(computed, exact, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("rate", [300.0, -1e6])
def test_a_plant_that_explodes_or_is_too_stiff_is_refused(tmp_path: Path, rate: float) -> None:
    table = plant_model(
        "fast",
        states=[Signal("x", "m", 1.0, description="state")],
        inputs=[Signal("u", "m", 1.0, 0.0, 3.0, "nothing")],
        disturbances=[],
        outputs=[Signal("cost", "1", description="nothing")],
        sampling_time=0.5,
    )
    equations = EQUATIONS.replace("v[VR_gain] * v[VR_u] - v[VR_x]", f"{rate!r} * v[VR_x]")
    equations = equations.replace("VR_y", "VR_cost")
    fmu = build_plant(table, equations, tmp_path / "fast.fmu")
    scenario = write_one_state(tmp_path / "fast.toml", fmu, "")
    with pytest.raises(PlantError, match="the states change too fast"), FmuPlant(scenario) as plant:
        plant.reset(0)
        for _ in range(20):
            plant.step([1.0])


def test_equations_that_do_not_compile_are_told(tmp_path: Path) -> None:
    with pytest.raises(BuildError, match="VR_nothing"):
        build_plant(model(), EQUATIONS.replace("VR_gain", "VR_nothing"), tmp_path / "lag.fmu")


FOREIGN = Path(__file__).parents[1] / "helpers" / "foreign"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A plant of C and XML by hand, which uses more of the C library than ours."""
    own = tmp_path / "own"
    own.mkdir()
    more = "#include <dirent.h>\nint more(DIR *folder) { return closedir(folder); }\n"
    (own / "tank.c").write_text(more + (FOREIGN / "tank.c").read_text())
    (own / "modelDescription.xml").write_bytes((FOREIGN / "tank.xml").read_bytes())
    return own


@pytest.mark.parametrize("every", [False, pytest.param(True, marks=[pytest.mark.slow, CROSS])])
def test_a_folder_becomes_an_fmu_for_this_or_every_platform(folder: Path, tmp_path: Path, every):
    fmu = build_folder(folder, tmp_path / "tank.fmu", every_platform=every)
    platforms = PLATFORMS if every else [present()]
    libraries = {f"binaries/{p.folder('2.0')}/tank{p.suffix}" for p in platforms}
    with zipfile.ZipFile(fmu) as archive:
        assert set(archive.namelist()) == {"modelDescription.xml", "sources/tank.c", *libraries}
    result = fmpy.simulate_fmu(str(fmu), stop_time=1.0, output_interval=0.5, output=["x"])
    assert result["x"][-1] == pytest.approx(0.6065306597126334)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('fmiVersion="2.0"', 'fmiVersion="1.0"', r"for FMI 1\.0, not 2\.0 or 3\.0"),
        ('modelIdentifier="tank"', 'modelIdentifier="../tank"', "is not a C identifier"),
        ("<CoSimulation ", "<Nothing ", "must name one modelIdentifier, not 0"),
        ("</fmiModelDescription>", "", "is not XML"),
    ],
)
def test_a_description_that_names_no_model_is_refused(
    folder: Path, tmp_path: Path, old: str, new: str, words: str
) -> None:
    path = folder / "modelDescription.xml"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(BuildError, match=words):
        build_folder(folder, tmp_path / "tank.fmu")
    assert not (tmp_path / "tank.fmu").exists()
