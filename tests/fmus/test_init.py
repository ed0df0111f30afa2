from __future__ import annotations

import zipfile

import pytest

import fmus


@pytest.mark.parametrize("name", ["evaporator", "evaporator_fmi3"])
def test_shipped_fmus_are_there(name: str) -> None:
    assert zipfile.is_zipfile(fmus.path(name))


def test_another_name_is_an_error_that_lists_those_shipped() -> None:
    with pytest.raises(fmus.FmuError, match="evaporator, evaporator_fmi3"):
        fmus.path("nothing")
