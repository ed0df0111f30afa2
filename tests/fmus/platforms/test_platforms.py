"""Each platform's binary gives the bits of the native one, where it can be run here."""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path

import pytest

import fmus
from fmus.build import HEADER, SOURCES
from fmus.description import MODEL_IDENTIFIER
from tests.helpers.platforms import (
    BY_NAME,
    NATIVE,
    OTHERS,
    STEPS,
    Importer,
    NotHereError,
    library,
    unzipped,
    verdict,
)

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("ziglang") is None, reason="the extra 'cross' is not installed"
    ),
]
LAWS = ["none", "uniform", "normal", "drifting"]


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory):
    """Lines that the host prints on a platform; skipped where it cannot be run."""
    folder = tmp_path_factory.mktemp("platforms")
    importer = Importer("host.c", {HEADER: (SOURCES / HEADER).read_bytes()}, folder / "host")
    for name in fmus.NAMES:
        unzipped(fmus.path(name), folder / name)

    @cache
    def runner(name: str, version: int, law: str) -> list[str]:
        root: Path = folder / fmus.NAMES[version - 2]
        file = library(root, BY_NAME[name], version, MODEL_IDENTIFIER)
        try:
            return importer.run(name, file, str(version), law, str(STEPS))
        except NotHereError as error:
            pytest.skip(str(error))

    return runner


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", OTHERS)
def test_ten_thousand_steps_are_bit_identical_to_the_native_ones(run, name, version, law) -> None:
    native, other = run(NATIVE, version, law), run(name, version, law)
    assert len(native) == STEPS + 1
    assert verdict(native, other) == "bit-identical"


@pytest.mark.parametrize("law", LAWS)
def test_both_fmi_versions_give_the_same_bits(run, law: str) -> None:
    assert run(NATIVE, 2, law) == run(NATIVE, 3, law)


def test_laws_differ(run) -> None:
    """The hashes see what they are to compare."""
    runs = {law: run(NATIVE, 2, law)[0] for law in LAWS[:3]}
    assert len(set(runs.values())) == 3
    assert run(NATIVE, 2, "normal")[1] != run(NATIVE, 2, "drifting")[1]
