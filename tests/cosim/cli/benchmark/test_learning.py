import io
import json
from pathlib import Path

import pytest

from cosim.cli.benchmark import learner_process, learning
from cosim.cli.benchmark.learning import CASES, measure
from cosim.errors import CosimError

ROOT = Path(__file__).parents[4]
PARTS = {"plant", "prepare", "feedback", "learning rule", "rest of the loop"}


@pytest.mark.slow
def test_a_rule_is_timed_beside_another_version_of_the_packages():
    done = []
    result = measure(
        "paper", 20, done.append, against=ROOT, cases=CASES[:1], repetitions=2, settling=20
    )
    assert done == [1]
    assert result["rows"][-1]["reference"] == str(ROOT)
    assert all(row["median_us"] > 0 for row in result["rows"])
    assert all(row["ratio"] > 0 for row in result["rows"])
    assert set(result["parts"][CASES[0].name]) == PARTS


def test_a_folder_without_packages_is_refused(tmp_path):
    with pytest.raises(CosimError, match="does not hold the package learning"):
        measure("paper", 20, print, against=tmp_path)


def test_a_process_that_dies_is_an_error_with_its_last_words(tmp_path):
    (tmp_path / "learning").mkdir()
    (tmp_path / "learning" / "__init__.py").write_text("raise RuntimeError('too old')")
    with learning._Worker({"PYTHONPATH": str(tmp_path)}) as worker:
        task = {"scenario": "paper", "algorithm": "q-learning", "samples": 1, "settings": {}}
        with pytest.raises(CosimError, match="a learner's process ended: RuntimeError: too old"):
            worker.ask(json.dumps(task))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_every_rule_learns_by_the_lines_that_it_is_sent(case):
    task = {
        "scenario": "paper",
        "algorithm": case.algorithm,
        "samples": 40,
        "settings": {**case.settings, "unknown to this version": 1},
    }
    answers = io.StringIO()
    learner_process.serve([json.dumps(task), "20", "profile 20"], answers)
    mode, seconds, parts = map(json.loads, answers.getvalue().splitlines())
    assert mode in ("interpreted", "compiled")
    assert seconds > 0
    assert set(parts) == PARTS
    assert all(value >= 0 for value in parts.values())


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

    monkeypatch.setattr(learner_process.time, "process_time", lambda: now)
    work, watch = Work(), learner_process.Stopwatch()
    watch.watch(work, "inner", "inner")
    watch.watch(work, "outer", "outer")
    work.outer()
    assert watch.seconds == {"inner": 20.0, "outer": 3.0}
