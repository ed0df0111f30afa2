import time

import pytest

from learning import benchmark


def test_every_algorithm_is_measured_and_its_time_adds_up(scenario, monkeypatch):
    monkeypatch.setattr(benchmark, "SETTLING", 50)
    result = benchmark.measure(scenario, 100, repetitions=2)
    assert [row["algorithm"] for row in result["rows"]] == list(benchmark.ALGORITHMS)
    for row in result["rows"]:
        parts = row["microseconds_per_sample"]
        assert set(parts) == {"plant", "prepare", "feedback", "learning rule", "rest of the loop"}
        assert all(value > 0 for value in parts.values())
        assert row["lowest_samples_per_second"] <= row["median_samples_per_second"]


def test_nested_calls_are_counted_once():
    class Work:
        def outer(self):
            self.inner()

        def inner(self):
            end = time.process_time() + 0.02
            while time.process_time() < end:
                pass

    work, watch = Work(), benchmark._Stopwatch()
    watch.watch(work, "inner", "inner")
    watch.watch(work, "outer", "outer")
    work.outer()
    assert watch.seconds["inner"] == pytest.approx(0.02, abs=0.01)
    assert watch.seconds["outer"] < 0.005


@pytest.mark.slow
def test_online_q_learning_makes_5000_samples_a_second(scenario):
    rows = benchmark.measure(scenario, 2000)["rows"]
    assert rows[0]["algorithm"] == "q-learning"
    assert rows[0]["highest_samples_per_second"] >= 5000
