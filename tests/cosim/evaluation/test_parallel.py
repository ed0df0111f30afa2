import pytest

from cosim.errors import EvaluationError
from cosim.evaluation.parallel import run_all
from tests.helpers.workers import die, die_once, refuse_three, square


def collect(function, tasks, **options):
    results = {}
    run_all(function, tasks.items(), results.__setitem__, **options)
    return results


NUMBERS = {str(i): i for i in range(8)}
SQUARES = {str(i): i * i for i in range(8)}


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_task_is_done_once(jobs):
    assert collect(square, NUMBERS, jobs=jobs) == SQUARES


@pytest.mark.parametrize("jobs", [1, 2])
def test_tasks_are_taken_from_the_source_as_workers_become_free(jobs):
    taken, lead = [], []
    tasks = ((str(i), taken.append(i) or i) for i in range(40))
    run_all(square, tasks, lambda key, _: lead.append(len(taken) - len(lead)), jobs=jobs)
    assert len(lead) == 40 and max(lead) <= 2 * jobs + 1


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_task_s_exception_is_raised(jobs):
    with pytest.raises(ValueError, match="three"):
        collect(refuse_three, NUMBERS, jobs=jobs)


def test_what_a_killed_worker_had_not_finished_is_done_by_another(tmp_path):
    marker = str(tmp_path / "marker")
    tasks = {key: (number, marker) for key, number in NUMBERS.items()}
    assert collect(die_once, tasks, jobs=2) == SQUARES
    assert (tmp_path / "marker").exists()


def test_workers_that_always_die_end_in_an_error_that_says_so():
    with pytest.raises(EvaluationError, match="died 3 times without finishing one of the"):
        collect(die, NUMBERS, jobs=2)


def test_no_job_is_refused():
    with pytest.raises(EvaluationError, match="jobs must be at least 1, not 0"):
        collect(square, NUMBERS, jobs=0)


@pytest.mark.slow
def test_a_scheduler_that_is_not_there_is_named():
    with pytest.raises(EvaluationError, match="no Dask scheduler answers at 'tcp:"):
        collect(square, NUMBERS, scheduler="tcp://127.0.0.1:9")
