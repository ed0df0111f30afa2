"""The environment of the tests, inherited by all processes that they start.

The user's cache is left alone: what tests unpack and solve ends with them.
"""

import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

# The same examples in every run, however busy the machine, so that a failure is the change's.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

# A shell's background job ignores Ctrl-C, what it starts inherits that, and tests send it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# pytest's own filter ends with this process; what tests start has to be as strict.
os.environ.setdefault("PYTHONWARNINGS", "error")
# Where no bytecode is kept, each process compiles the packages' Python anew, and each of pytest's
# the tests' assertions.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# As users have it: what is long is compiled. Tests of the interpreted path say so (`interpreted`).
os.environ.pop("COSIM_COMPILE", None)
OWN = "COSIM_CACHE" not in os.environ
if OWN:
    # Before any test module is imported, and inherited by pytest's and our own worker processes.
    os.environ["COSIM_CACHE"] = tempfile.mkdtemp(prefix="cosim-tests-")
    os.environ.setdefault("DASK_TEMPORARY_DIRECTORY", os.environ["COSIM_CACHE"])
    # All processes share this cache, so that each library is compiled once. Without optimisation
    # that takes a tenth of the time; without contraction of products and sums the digits are the
    # same.
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if os.name == "posix" and "CC" not in os.environ and compiler is not None:
        quick_compiler = Path(os.environ["COSIM_CACHE"], "cc")
        quick_compiler.write_text(f'#!/bin/sh\nexec {compiler} "$@" -O0\n')
        quick_compiler.chmod(0o700)
        os.environ["CC"] = str(quick_compiler)


def pytest_unconfigure():
    if OWN:
        shutil.rmtree(os.environ["COSIM_CACHE"], ignore_errors=True)


@pytest.fixture(autouse=True)
def modules_as_before():
    """A test in which users' modules are loaded anew leaves those of the tests to the next one.

    Nor does the next one look for modules in this one's folders.
    """
    from cosim.core import modules

    tests = {name: module for name, module in sys.modules.items() if name.startswith("tests.")}
    folders = list(modules._folders)
    yield
    sys.modules.update(tests)
    modules._folders[:] = folders


@pytest.fixture(scope="session")
def paper():
    from cosim import Scenario

    return Scenario.load("paper")


@pytest.fixture
def interpreted(monkeypatch):
    """Controllers are computed by CasADi's interpreter, however long a run is."""
    monkeypatch.setenv("COSIM_COMPILE", "never")


@pytest.fixture
def rng():
    return np.random.default_rng(20200513)


@pytest.fixture
def quickly_built(monkeypatch):
    """FMUs are compiled without optimisation: the same digits, in half of the time."""
    from fmus import build

    flags = [flag.replace("-O2", "-O0") for flag in build.COMPILER_FLAGS]
    monkeypatch.setattr(build, "COMPILER_FLAGS", flags)
