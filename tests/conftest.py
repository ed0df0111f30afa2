"""The environment of the tests, inherited by all processes that they start.

The user's cache is left alone: what tests unpack and solve ends with them.
"""

import os
import shutil
import signal
import tempfile

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
# Some of them are a fifth slower where each command compiles the packages' Python anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
# Compiled controllers have tests of their own (tests/controllers/rti/test_engine.py); a
# cache that begins empty would have every test process compile them anew beside the others.
os.environ.setdefault("COSIM_COMPILE", "never")
OWN = "COSIM_CACHE" not in os.environ
if OWN:
    # Before any test module is imported, and inherited by pytest's and our own worker processes.
    os.environ["COSIM_CACHE"] = tempfile.mkdtemp(prefix="cosim-tests-")
    os.environ.setdefault("DASK_TEMPORARY_DIRECTORY", os.environ["COSIM_CACHE"])


def pytest_unconfigure():
    if OWN:
        shutil.rmtree(os.environ["COSIM_CACHE"], ignore_errors=True)


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
