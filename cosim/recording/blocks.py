"""Joins blocks of a run, so that each signal costs one call to Rerun for many samples."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from cosim.protocols import Array, Block

_PREDICTIONS = ("predicted_states", "predicted_actions")


def joined(blocks: Sequence[Block]) -> Block:
    """Consecutive blocks as one; rows of a block without predictions are NaN."""
    columns: dict[str, Any] = {
        field.name: np.concatenate([getattr(block, field.name) for block in blocks])
        for field in fields(Block)
        if field.name not in ("first", "status", *_PREDICTIONS)
    }
    predictions: dict[str, Any] = {name: _predictions(blocks, name) for name in _PREDICTIONS}
    status = [word for block in blocks for word in block.status]
    return Block(first=blocks[0].first, status=status, **columns, **predictions)


def _predictions(blocks: Sequence[Block], name: str) -> Array | None:
    shape = next((getattr(b, name).shape[1:] for b in blocks if getattr(b, name) is not None), None)
    if shape is None:
        return None
    return np.concatenate(
        [
            np.full((len(block.time), *shape), np.nan)
            if getattr(block, name) is None
            else getattr(block, name)
            for block in blocks
        ]
    )
