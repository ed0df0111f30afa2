"""Words and frames are legible on the viewer's dark and on its light background."""

import numpy as np
import pytest

from cosim.recording.palette import FRAME


def luminance(color):
    """Relative luminance of `#RRGGBB` (WCAG 2.2)."""
    share = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


@pytest.mark.parametrize("background", ["#0D0D0D", "#FFFFFF"])
def test_the_words_stand_out_from_the_background(background):
    dark, light = sorted((luminance(FRAME), luminance(background)))
    assert (light + 0.05) / (dark + 0.05) >= 4.0
