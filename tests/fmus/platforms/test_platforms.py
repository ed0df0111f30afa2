"""Each platform's binary gives the bits of the native one, where it can be run here."""

from __future__ import annotations

from functools import cache

import pytest

from tests.helpers.platforms import (
    LAWS,
    MARKS,
    NATIVE,
    OTHERS,
    STEPS,
    VERSIONS,
    hosted_plant,
    verdict,
)

pytestmark = MARKS


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory):
    """Lines that the host prints on a platform; skipped where it cannot be run."""
    folder = tmp_path_factory.mktemp("platforms")
    plants = {version: hosted_plant(version, folder) for version in VERSIONS}

    @cache
    def runner(name: str, version: int, law: str) -> list[str]:
        return plants[version].run_or_skip(name, law)

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
