"""Nothing that a command started outlives it where only its first process is killed."""

import sys

import pytest

from tests.faults.orphans import JOBS, campaign
from tests.helpers.drawing import skip_without_driver

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")


def held(trials, seed, *names):
    try:
        return campaign(trials, seed, names)
    except AssertionError as error:
        skip_without_driver(str(error))
        raise


@pytest.mark.slow
@pytest.mark.parametrize("job", ["evaluate --jobs"])
def test_a_killed_parent_leaves_nothing(monkeypatch, job):
    monkeypatch.delenv("COSIM_COMPILE", raising=False)
    assert held(1, 5, job)[job]["trials"] == 1


@pytest.mark.campaign
@pytest.mark.parametrize("job", [job.name for job in JOBS])
def test_ten_killed_parents_leave_nothing(monkeypatch, job):
    monkeypatch.delenv("COSIM_COMPILE", raising=False)
    assert held(10, 6, job)[job]["trials"] == 10
