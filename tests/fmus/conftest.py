"""Instances of the shipped evaporator, for both versions of FMI."""

from collections.abc import Callable, Iterator
from pathlib import Path

import fmpy
import pytest

import fmus
from tests.helpers.instance import Instance

NAMES = {2: "evaporator", 3: "evaporator_fmi3"}


@pytest.fixture(scope="session")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The shipped FMUs, unzipped once."""
    extracted = {}
    for version, name in NAMES.items():
        folder = tmp_path_factory.mktemp(name)
        fmpy.extract(str(fmus.path(name)), str(folder))
        extracted[version] = folder
    return extracted


@pytest.fixture(params=[2, 3], ids=["fmi2", "fmi3"])
def version(request: pytest.FixtureRequest) -> int:
    return int(request.param)


@pytest.fixture
def open_fmu(folders: dict[int, Path]) -> Iterator[Callable[..., Instance]]:
    """Open any number of instances; all are freed after the test."""
    opened: list[Instance] = []

    def opener(version: int, exchange: bool = False, logging: bool = False, **asked) -> Instance:
        opened.append(Instance(folders[version], version, exchange, logging, **asked))
        return opened[-1]

    yield opener
    for instance in opened:
        instance.close()


@pytest.fixture
def plant(open_fmu: Callable[..., Instance], version: int) -> Instance:
    """A fresh co-simulation instance of each FMI version."""
    return open_fmu(version)


@pytest.fixture
def model(open_fmu: Callable[..., Instance], version: int) -> Instance:
    """A fresh model-exchange instance of each FMI version."""
    return open_fmu(version, exchange=True)
