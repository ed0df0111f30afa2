import os
import stat
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import fmus
from cosim.core.errors import PlantError
from cosim.plant import fmi
from cosim.plant.fmi import place, unpack
from tests.helpers.command import run_cosim
from tests.helpers.tank import edited


def test_a_shipped_fmu_is_found_by_name_and_unpacked_once():
    first = unpack("evaporator")
    assert first.path == fmus.path("evaporator").resolve()
    assert (first.folder / "modelDescription.xml").is_file()
    assert unpack("evaporator").folder == first.folder
    assert unpack(fmus.path("evaporator")).folder == first.folder


def _zip(path, entries):
    with zipfile.ZipFile(path, "w") as target:
        for name, data in entries:
            target.writestr(name, data)
    return path


def _link(path):
    info = zipfile.ZipInfo("resources/passwd")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return _zip(path, [("modelDescription.xml", "<x/>"), (info, "/etc/passwd")])


def _written(path, data):
    path.write_bytes(data)
    return path


def _changed(path, old, new):
    return edited(fmus.path(), path, lambda text: text.replace(old, new))


REFUSED = {
    "text": (lambda p: _written(p, b"not a zip"), "not an FMU"),
    "no description": (lambda p: _zip(p, [("a", "b")]), "no modelDescription.xml"),
    "no XML": (lambda p: _zip(p, [("modelDescription.xml", "hello")]), "invalid model description"),
    "schema": (lambda p: _changed(p, "ModelVariables>", "Mod>"), "invalid model description"),
    "FMI 9": (lambda p: _changed(p, 'fmiVersion="2.0"', 'fmiVersion="9"'), "9"),
    "parent folder": (lambda p: _zip(p, [("../evil", "x")]), "leads outside"),
    "absolute": (lambda p: _zip(p, [("/etc/evil", "x")]), "leads outside"),
    "backslash": (lambda p: _zip(p, [("..\\evil", "x")]), "leads outside"),
    "drive": (lambda p: _zip(p, [("C:evil", "x")]), "leads outside"),
    "link": (_link, "is a link"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_honest_fmu_is_refused_in_one_line(case, tmp_path):
    make, said = REFUSED[case]
    path = make(tmp_path / "bad.fmu")
    with pytest.raises(PlantError) as error:
        unpack(path)
    message = str(error.value)
    assert "bad.fmu" in message and said in message and "\n" not in message
    assert not list(tmp_path.glob("**/evil"))


def test_an_archive_of_absurd_size_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    path = _zip(tmp_path / "big.fmu", [("modelDescription.xml", "x" * 3000)])
    monkeypatch.setattr(fmi, "MAX_BYTES", 2999)
    with pytest.raises(PlantError, match="unpacks to more than"):
        unpack(path)
    monkeypatch.setattr(fmi, "MAX_ENTRIES", 0)
    with pytest.raises(PlantError, match="more than 0 entries"):
        unpack(path)


def test_an_fmu_without_a_binary_for_this_platform_says_what_it_has(tmp_path, paper):
    from cosim import FmuPlant

    path = tmp_path / "foreign.fmu"
    with zipfile.ZipFile(fmus.path()) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            new.writestr(entry.filename.replace("linux64", "amiga68k"), old.read(entry))
    with pytest.raises(PlantError, match=r"no binary for x86_64-linux \(it has: .*amiga68k, "):
        FmuPlant(paper, path)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "fmus"


@pytest.fixture
def archive():
    with zipfile.ZipFile(fmus.path()) as archive:
        yield archive


def contents(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def entries(cache):
    return [path for path in cache.iterdir() if path.suffix != ".lock"]


def packed(archive):
    return {name: archive.read(name) for name in archive.namelist()}


def test_the_folder_holds_the_archive_and_nothing_else_is_left(cache, archive):
    folder = place(archive, "0" * 64)
    assert contents(folder) == packed(archive)
    assert entries(cache) == [folder]
    assert stat.S_IMODE(cache.stat().st_mode) == 0o700


@pytest.mark.parametrize("damage", ["changed", "cut", "missing", "link"])
def test_a_damaged_folder_is_replaced(cache, archive, damage, tmp_path):
    folder = place(archive, "0" * 64)
    library = next(folder.glob("binaries/*/*"))
    data = library.read_bytes()
    library.unlink()
    if damage == "changed":
        library.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    elif damage == "cut":
        library.write_bytes(data[:-1])
    elif damage == "link":
        (tmp_path / "elsewhere").write_bytes(data)
        library.symlink_to(tmp_path / "elsewhere")
    assert contents(place(archive, "0" * 64)) == packed(archive)
    assert entries(cache) == [folder]
    assert not library.is_symlink()


RACE = """
import sys, zipfile
from cosim.plant.fmi import place
sys.stdin.readline()
with zipfile.ZipFile(sys.argv[1]) as archive:
    for _ in range(20):
        print((place(archive, "0" * 64) / "modelDescription.xml").stat().st_size)
"""


@pytest.mark.slow
def test_processes_that_unpack_at_once_agree(cache, archive):
    command = [sys.executable, "-c", RACE, str(fmus.path())]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    racers = [subprocess.Popen(command, **pipes) for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        said = list(pool.map(lambda racer: racer.communicate("go\n")[0], racers))
    assert {racer.returncode for racer in racers} == {0}
    size = archive.getinfo("modelDescription.xml").file_size
    assert "".join(said).split() == [str(size)] * 80
    assert contents(cache / ("0" * 64)) == packed(archive)
    assert len(entries(cache)) == 1


def test_without_a_cache_the_folder_ends_with_the_process(tmp_path):
    temporary, file = tmp_path / "temporary", tmp_path / "file"
    temporary.mkdir()
    file.touch()
    code = "from cosim.plant.fmi import unpack; print(unpack('evaporator').folder)"
    said = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"COSIM_CACHE": str(file), "TMPDIR": str(temporary)},
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert Path(said.strip()).parents[1] == temporary
    assert not list(temporary.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        "simulate --steps 30 --record --out out",
        "evaluate --seeds 2 --steps 30 --jobs 2 --out out",
        "train --algorithm q-learning --samples 100 --log-every 50 --evaluate-every 100 --out out",
        "demo --samples 100 --steps 30 --out out",
    ],
)
def test_a_command_leaves_nothing_in_the_folder_for_temporary_files(tmp_path, words):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    own = {"TMPDIR": str(temporary), "COSIM_CACHE": str(tmp_path / "cache")}
    run_cosim(*words.split(), folder=tmp_path, env=own, check=True)
    assert not list(temporary.rglob("*"))
