import os
import stat
import subprocess
import sys
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import fmus
from cosim.plant.fmi import place
from tests.helpers.command import run_cosim


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
        "demo --steps 30 --out out",
    ],
)
def test_a_command_leaves_nothing_in_the_folder_for_temporary_files(tmp_path, words):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    own = {"TMPDIR": str(temporary), "COSIM_CACHE": str(tmp_path / "cache")}
    run_cosim(*words.split(), folder=tmp_path, env=own, check=True)
    assert not list(temporary.rglob("*"))
