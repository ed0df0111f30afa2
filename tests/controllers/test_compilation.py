"""C files compiled into a cache: whole, once, and without an endless wait."""

import ctypes
import io
import shutil
import sys
import tarfile
import warnings

import pytest

from benchmarks.builds import SYSTEMS, built, preset_sources
from controllers import ControllerError, Parameters, RtiNmpc, functions
from controllers.errors import ModelWarning
from controllers.factories import naive
from controllers.functions import BUILDS, build_name, description, find_compiler, library
from cosim import FmuPlant, Scenario, simulate
from cosim.core import errors
from fmus import present
from tests.helpers.compiler import needs_compiler
from tests.helpers.sampling import evaporator_problem

FAILS = shutil.which("false") or sys.executable
SOURCES = {"answer.c": '#include "answer.h"\nint answer(void) { return ANSWER; }\n'}


def answer(value):
    return library(SOURCES | {"answer.h": f"#define ANSWER {value}\n"})


@pytest.fixture
def folder(monkeypatch, tmp_path):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("COSIM_COMPILE", raising=False)
    return tmp_path / "cache" / "compiled"


@needs_compiler
def test_a_library_is_made_once_for_its_content(folder):
    first, other = answer(42), answer(43)
    assert answer(42) == first
    assert [ctypes.CDLL(str(path)).answer() for path in (first, other)] == [42, 43]
    assert sorted(folder.glob("*.lib")) == sorted([first, other])


ENTRY_POINTS = (
    b"engine_run\0",
    b"filter_predict\0",
    b"rollout\0",
    b"features_at\0",
    b"optimal_run\0",
)
"""Of each library that is stored, one is a public function."""


def test_without_a_compiler_there_is_none_and_the_description_says_so(folder, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    assert answer(42) is None
    assert "no C compiler" in description()


@pytest.fixture(scope="module")
def presets_sources():
    return preset_sources()


@pytest.mark.slow
def test_the_stored_builds_are_those_of_the_presets(presets_sources):
    names = {build_name(each, system) for each in presets_sources for system in SYSTEMS.values()}
    with tarfile.open(BUILDS) as builds:
        assert set(builds.getnames()) == names, "python -m benchmarks.builds"
        for build in (builds.extractfile(name).read() for name in names):
            assert any(function in build for function in ENTRY_POINTS)


@pytest.mark.slow
def test_a_stored_build_is_what_its_sources_give(presets_sources):
    pytest.importorskip("ziglang")
    with tarfile.open(BUILDS) as builds:
        for sources in presets_sources[:2]:
            name = build_name(sources, SYSTEMS[present().tuple])
            assert builds.extractfile(name).read() == built(sources, present())


@needs_compiler
def test_a_stored_build_gives_the_compilers_bytes(folder, monkeypatch, tmp_path):
    scenario, tables = Scenario.load("paper"), []
    nowhere = tmp_path / "builds.tar.xz"
    for compiler, builds in ((find_compiler(), nowhere), ("no-such-compiler", BUILDS)):
        monkeypatch.setenv("CC", compiler)
        monkeypatch.setattr(functions, "BUILDS", builds)
        controller = naive(scenario)
        controller.compile()
        assert controller.functions == "compiled"
        with FmuPlant(scenario) as plant:
            tables.append(simulate(plant, controller, 200, seed=1).to_csv())
    assert tables[0] == tables[1]
    assert len(list(folder.glob("*.lib"))) == 2


@needs_compiler
def test_a_stored_build_is_taken_where_there_is_a_compiler_too(folder, monkeypatch, tmp_path):
    sources = {
        name: text.encode() for name, text in (SOURCES | {"answer.h": "#define ANSWER 7\n"}).items()
    }
    name = build_name(sources, SYSTEMS[present().tuple])
    builds = tmp_path / "builds.tar.xz"
    with tarfile.open(builds, "w:xz") as archive:
        entry = tarfile.TarInfo(name)
        entry.size = len(b"stored")
        archive.addfile(entry, io.BytesIO(b"stored"))
    monkeypatch.setattr(functions, "BUILDS", builds)
    monkeypatch.setenv("CC", FAILS)
    assert library(sources).read_bytes() == b"stored"
    with pytest.warns(ModelWarning, match="failed"):
        assert answer(8) is None


@pytest.mark.slow
def test_a_compiler_that_fails_or_hangs_leaves_nothing(folder, monkeypatch, tmp_path):
    monkeypatch.setenv("CC", FAILS)
    with pytest.warns(ModelWarning, match="failed with status 1"):
        assert answer(42) is None
    hangs = tmp_path / "cc"
    hangs.write_text("#!/bin/sh\nsleep 600\n")
    hangs.chmod(0o700)
    monkeypatch.setenv("CC", str(hangs))
    monkeypatch.setattr(functions, "HANGING", 0.5)
    with pytest.warns(ModelWarning, match=r"did not end in 0\.5 s"):
        assert answer(42) is None
    assert list(folder.glob("*.lib")) == []


@pytest.mark.slow
def test_a_compiler_may_wait_but_not_compute_for_long(folder, monkeypatch, tmp_path):
    monkeypatch.setattr(functions, "PATIENCE", 1.0)
    waits = tmp_path / "waits"
    waits.write_text('#!/bin/sh\nsleep 2\nexec cc "$@"\n')
    computes = tmp_path / "computes"
    computes.write_text("#!/bin/sh\nwhile :; do :; done\n")
    for script in (waits, computes):
        script.chmod(0o700)
    monkeypatch.setenv("CC", str(waits))
    assert answer(43) is not None
    monkeypatch.setenv("CC", str(computes))
    with pytest.warns(ModelWarning, match=r"took longer than 1 s of the processor"):
        assert answer(44) is None


@pytest.mark.skipif(sys.platform == "win32", reason="the compiler is a shell script")
def test_a_compiler_that_failed_is_not_tried_again_on_the_same_files(folder, monkeypatch, tmp_path):
    calls = tmp_path / "calls"
    script = tmp_path / "cc"
    script.write_text(f"#!/bin/sh\necho call >> {calls}\nexit 1\n")
    script.chmod(0o700)
    monkeypatch.setenv("CC", str(script))
    for _ in range(2):
        monkeypatch.setattr(errors, "_WARNED", {})  # as in another process
        with pytest.warns(ModelWarning, match="interpreted"):
            assert answer(44) is None
    assert len(calls.read_text().splitlines()) == 1
    with pytest.warns(ModelWarning):
        assert answer(45) is None
    assert len(calls.read_text().splitlines()) == 2


@needs_compiler
@pytest.mark.parametrize(
    "deed",
    [
        "head -c 100 /dev/zero > library; exit 1",
        "rm -rf ../.partial-*",
        "rm -rf $COSIM_CACHE",
        "true",
    ],
    ids=["full disk", "own folder", "whole cache", "nothing written"],
)
def test_a_compiler_that_breaks_its_surroundings_is_survived(folder, monkeypatch, tmp_path, deed):
    script = tmp_path / "cc"
    script.write_text(f"#!/bin/sh\n{deed}\n")
    script.chmod(0o700)
    with monkeypatch.context() as patched:
        patched.setenv("CC", str(script))
        with warnings.catch_warnings():
            # Where the cache itself was removed there is no note, and no warning.
            warnings.simplefilter("ignore", ModelWarning)
            assert answer(42) is None
    assert ctypes.CDLL(str(answer(42))).answer() == 42


def test_never_means_never_and_an_unknown_word_in_the_switch_is_refused(folder, monkeypatch):
    monkeypatch.setenv("COSIM_COMPILE", "never")
    assert answer(42) is None
    monkeypatch.setenv("COSIM_COMPILE", "yes")
    with pytest.raises(ControllerError):
        answer(42)


@pytest.mark.slow
@needs_compiler
def test_a_long_run_is_compiled_and_a_shorter_one_is_not(folder):
    problem = evaporator_problem(horizon=2)
    long, short = (RtiNmpc(problem, Parameters.naive(problem)) for _ in range(2))
    long.compile(functions.LONG)
    short.compile(functions.LONG - 1)
    assert (long.functions, short.functions) == ("compiled", "interpreted")
