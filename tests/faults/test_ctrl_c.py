"""One Ctrl-C at an early moment is one line and exit code 130."""

import os

import pytest

from tests.faults.ctrl_c import COMMANDS, campaign

pytestmark = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX")


@pytest.mark.slow
def test_one_ctrl_c_is_one_line():
    assert all(seen["held"] == 1 for seen in campaign(len(COMMANDS), 3).values())


@pytest.mark.campaign
def test_a_hundred_times():
    campaign(100, 4)
