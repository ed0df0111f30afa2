"""Joins blocks of a run, so that each signal costs one call to Rerun for many samples."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cosim.protocols import Array, SampleBlock


def joined(blocks: Sequence[SampleBlock]) -> SampleBlock:
    """Consecutive blocks as one; rows of a block without predictions are NaN."""
    return SampleBlock(
        first=blocks[0].first,
        columns={
            name: np.concatenate([block[name] for block in blocks]) for name in blocks[0].columns
        },
        status=[word for block in blocks for word in block.status],
        predicted_states=_predictions(blocks, "predicted_states"),
        predicted_actions=_predictions(blocks, "predicted_actions"),
    )


def _predictions(blocks: Sequence[SampleBlock], name: str) -> Array | None:
    parts = [getattr(block, name) for block in blocks]
    shape = next((part.shape[1:] for part in parts if part is not None), None)
    if shape is None:
        return None
    return np.concatenate(
        [
            np.full((len(block), *shape), np.nan) if part is None else part
            for block, part in zip(blocks, parts, strict=True)
        ]
    )
