"""What the command line says of a plant and a controller before it builds them."""

import pytest

from cosim import Scenario
from cosim.cli.compose import LONG, announce


class Notes:
    stdout = None

    def __init__(self):
        self.lines = []

    def note(self, text):
        self.lines.append(text)


@pytest.mark.parametrize(("stages", "said"), [(10, 0), (LONG, 0), (LONG + 1, 1), (1000, 1)])
def test_a_horizon_that_takes_its_time_is_announced(stages, said):
    notes = Notes()
    announce(Scenario.load("paper").replace({"controller": {"horizon": stages}}), notes)
    assert len(notes.lines) == said
    assert all(f"horizon {stages}: building" in line for line in notes.lines)
