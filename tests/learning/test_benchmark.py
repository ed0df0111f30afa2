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


def test_nested_calls_are_counted_once(monkeypatch):
    now = 0.0

    class Work:
        def outer(self):
            spend(3.0)
            self.inner()

        def inner(self):
            spend(20.0)

    def spend(seconds):
        nonlocal now
        now += seconds

    monkeypatch.setattr(benchmark.time, "process_time", lambda: now)
    work, watch = Work(), benchmark._Stopwatch()
    watch.watch(work, "inner", "inner")
    watch.watch(work, "outer", "outer")
    work.outer()
    assert watch.seconds == {"inner": 20.0, "outer": 3.0}
