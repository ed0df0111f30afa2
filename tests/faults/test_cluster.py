"""Whatever a Dask address leads to, a run ends, within a time, in results or in one clear line."""

import shutil
import signal
import sys
import threading
import time

import pytest

from controllers.factories import naive
from cosim import evaluate
from cosim.errors import EvaluationError
from cosim.studies import run as engine
from tests.helpers.schedulers import ANSWERS, PACKAGES, ROOT, listener, processes

pytest.importorskip("distributed")
FORMS = [
    "",
    "nonsense",
    "tcp://127.0.0.1:9",
    "tcp://127.0.0.1:99999",
    "tls://127.0.0.1:9",
    "gateway://x:1",
]


def run(address, seeds=2, steps=20, **options):
    return evaluate("paper", {"naive": naive}, seeds, steps, scheduler=address, **options)


def refused(address):
    with pytest.raises(EvaluationError) as caught:
        run(address, seeds=1)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 800


@pytest.fixture
def soon(monkeypatch):
    """Let what takes its time take little."""
    monkeypatch.setattr(engine, "ANSWER_SECONDS", 0.2)


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("address", FORMS)
def test_an_address_that_leads_nowhere_is_named(address):
    refused(address)


@pytest.mark.usefixtures("soon")
@pytest.mark.parametrize("answer", ANSWERS)
def test_a_server_that_is_no_scheduler_is_named(answer):
    with listener(ANSWERS[answer]) as address:
        refused(address)


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(EvaluationError, match="cluster"):
        run("tcp://127.0.0.1:9")


# With real schedulers and workers --------------------------------------------------------------

SLOW = pytest.mark.slow


@SLOW
def test_a_sound_cluster_gives_the_bytes_of_one_process():
    with processes(workers=2) as there:
        table = run(there.address)
    assert table.to_csv() == evaluate("paper", {"naive": naive}, 2, 20).to_csv()


@SLOW
def test_a_cluster_without_workers_is_named(monkeypatch):
    monkeypatch.setattr(engine, "WORKER_SECONDS", 2.0)
    with processes(workers=0) as there:
        refused(there.address)


@SLOW
def test_a_worker_of_another_version_is_named(tmp_path):
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package)
    with (tmp_path / "cosim" / "simulation.py").open("a") as file:
        file.write("\n# another version\n")
    with processes(code=tmp_path) as there:
        refused(there.address)


@SLOW
@pytest.mark.parametrize("number", ["SIGKILL", "SIGSTOP"])
def test_a_scheduler_that_ends_or_hangs_ends_the_run_and_loses_nothing(number, tmp_path):
    rows = tmp_path / "runs" / "paper" / "naive" / "evaluation.csv"

    def stop_later(scheduler):
        while not rows.exists():
            time.sleep(0.05)
        scheduler.send_signal(signal.Signals[number])

    with processes() as there:
        stop = threading.Thread(target=stop_later, args=(there.scheduler,))
        stop.start()
        with pytest.raises(EvaluationError) as caught:
            run(there.address, seeds=400, steps=5000, folder=tmp_path)
        stop.join()
    assert "\n" not in str(caught.value)
    assert 1 <= len(rows.read_text().splitlines()) - 1 < 400
