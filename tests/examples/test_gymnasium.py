"""The learners on the Gymnasium environments learn."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cosim import Scenario

FOLDER = Path(__file__).parents[2] / "examples" / "gymnasium"
pytestmark = pytest.mark.slow


def costs(script, *options):
    """J on held-out disturbances by the plant samples used."""
    done = subprocess.run(
        [sys.executable, FOLDER / script, *options, "--seed", "0"],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"PYTHONWARNINGS": "default"},  # the learners' own libraries warn
    )
    rows = [line.split() for line in done.stdout.splitlines() if "plant samples" in line]
    return {int(row[0]): float(row[-1]) for row in rows}


def test_the_cross_entropy_method_comes_within_a_few_per_cent_of_the_operating_point():
    reference = Scenario.load("paper").controller.reference_cost
    found = costs("cross_entropy.py")
    assert list(found) == [0, 36000, 72000, 108000, 144000]
    assert found[144000] < 1.04 * reference < found[0]


def test_ppo_lowers_the_cost():
    pytest.importorskip("stable_baselines3")
    found = list(costs("proximal_policy.py", "--steps", "10000").values())
    assert found[-1] < found[0]
