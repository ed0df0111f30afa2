from __future__ import annotations

from fmus.build import HEADER, SOURCES, header, model_token


def test_committed_header_is_not_stale() -> None:
    assert (SOURCES / HEADER).read_text() == header(model_token()), (
        "run `cosim fmu build --in-place` and commit what it writes"
    )
