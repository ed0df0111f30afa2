"""Colours of the recordings, legible on the viewer's dark and light background."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

SERIES = ("#3B94DE", "#E8731F", "#22AC7E", "#CC79A7", "#E5A11A", "#6CC3F0")
BOUND = "#D8392B"
REFERENCE = "#8A96A3"
FRAME = "#767C82"
GOOD = "#3A9A5B"


def packed(color: str) -> int:
    """`#RRGGBB` as the opaque 32-bit number that Rerun takes."""
    return int(color.removeprefix("#") + "FF", 16)


def packed_all(colors: Sequence[str]) -> NDArray[np.uint32]:
    """`#RRGGBB` strings as 32-bit numbers; an array, since Rerun misreads a list of three."""
    return np.array([packed(color) for color in colors], dtype=np.uint32)
