"""FMUs of one's own: from a folder with C and XML, for this platform or for all."""

from __future__ import annotations

import importlib.util
import os
import shutil
import zipfile
from pathlib import Path

import fmpy
import pytest

from fmus.errors import BuildError
from fmus.own import build_fmu, build_folder
from fmus.platforms import PLATFORMS, present

FOREIGN = Path(__file__).parents[1] / "helpers" / "foreign"
pytestmark = pytest.mark.skipif(
    shutil.which(os.environ.get("CC", "cc")) is None, reason="there is no C compiler"
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A plant of C and XML by hand."""
    own = tmp_path / "own"
    own.mkdir()
    (own / "tank.c").write_bytes((FOREIGN / "tank.c").read_bytes())
    (own / "modelDescription.xml").write_bytes((FOREIGN / "tank.xml").read_bytes())
    return own


def members(path: Path) -> set[str]:
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


def test_a_folder_becomes_an_fmu_for_this_platform(folder: Path, tmp_path: Path) -> None:
    fmu = build_folder(folder, tmp_path / "tank.fmu")
    library = f"binaries/{present().folder('2.0')}/tank{present().suffix}"
    assert members(fmu) == {"modelDescription.xml", library, "sources/tank.c"}
    result = fmpy.simulate_fmu(str(fmu), stop_time=1.0, output_interval=0.5, output=["x"])
    assert result["x"][-1] == pytest.approx(0.6065306597126334)


def test_two_builds_are_byte_identical(folder: Path, tmp_path: Path) -> None:
    first, second = (build_folder(folder, tmp_path / name) for name in ("one.fmu", "two.fmu"))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("ziglang") is None, reason="the extra 'cross' is not installed"
)
def test_a_folder_becomes_an_fmu_for_every_platform(folder: Path, tmp_path: Path) -> None:
    fmu = build_folder(folder, tmp_path / "tank.fmu", every_platform=True)
    libraries = {f"binaries/{p.folder('2.0')}/tank{p.suffix}" for p in PLATFORMS}
    assert libraries <= members(fmu)
    result = fmpy.simulate_fmu(str(fmu), stop_time=1.0, output_interval=0.5, output=["x"])
    assert result["x"][-1] == pytest.approx(0.6065306597126334)


def test_further_files_go_along(folder: Path, tmp_path: Path) -> None:
    sources = {"tank.c": (folder / "tank.c").read_bytes()}
    text = (folder / "modelDescription.xml").read_text()
    fmu = build_fmu(tmp_path / "a.fmu", sources, text, files={"resources/data.csv": b"1"})
    assert "resources/data.csv" in members(fmu)


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


@pytest.mark.parametrize(
    ("missing", "words"), [("tank.c", "no C source"), ("modelDescription.xml", "No such file")]
)
def test_a_missing_file_is_told(folder: Path, tmp_path: Path, missing: str, words: str) -> None:
    (folder / missing).unlink()
    with pytest.raises(BuildError, match=words):
        build_folder(folder, tmp_path / "tank.fmu")


def test_what_the_compiler_says_is_told(folder: Path, tmp_path: Path) -> None:
    (folder / "tank.c").write_text("int main(void) { return nothing; }\n")
    with pytest.raises(BuildError, match="nothing"):
        build_folder(folder, tmp_path / "tank.fmu")
