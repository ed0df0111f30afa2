"""`cosim benchmark` runs the checkout's folder `benchmarks`, which the wheel does not have."""

import json

import pytest

from cosim.cli import benchmark
from tests.helpers.command import run_cosim


@pytest.mark.parametrize(
    "words",
    [
        ("plant", 50),
        pytest.param(("controllers", 30), marks=pytest.mark.slow),
        pytest.param(("learning", 10), marks=pytest.mark.slow),
        pytest.param(("export", 100), marks=pytest.mark.slow),
        pytest.param(("evaluation", 10), marks=pytest.mark.slow),
        pytest.param(("scaling", 2), marks=pytest.mark.slow),
    ],
)
def test_every_time_is_positive_and_a_reference_has_a_ratio(words):
    name, steps = words
    done = run_cosim("benchmark", name, "--steps", steps, "--json")
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["rows"]
    assert all(0.0 < row["minimum_us"] <= row["median_us"] <= row["p95_us"] for row in rows)
    assert all((row["ratio"] is None) == (row["reference"] is None) for row in rows)


def test_without_a_checkout_it_says_what_to_do(cosim, monkeypatch, tmp_path):
    monkeypatch.setattr(benchmark, "__file__", str(tmp_path / "a" / "b" / "c.py"))
    code, _, said = cosim("benchmark", "plant")
    assert (code, said.count("\n")) == (2, 1)
