"""Whatever a Dask address leads to, a run ends, within a time, in results or in one clear line."""

import logging
import shutil
import signal
import subprocess
import sys
import threading
from functools import partial

import pytest

from controllers.factories import naive
from cosim import evaluate
from cosim.errors import EvaluationError
from cosim.evaluation import cluster, parallel
from cosim.evaluation.parallel import run_all
from cosim.evaluation.store import FILE
from tests.helpers.command import run_cosim
from tests.helpers.schedulers import ANSWERS, OURS, PACKAGES, ROOT, listener, processes
from tests.helpers.workers import square

pytest.importorskip("distributed")
FORMS = [
    "",
    " ",
    "nonsense",
    "processes",
    "tcp://",
    "tcp://:",
    "tcp://127.0.0.1",
    "tcp://127.0.0.1:",
    "tcp://127.0.0.1:port",
    "tcp://127.0.0.1:0",
    "tcp://127.0.0.1:9",
    "tcp://127.0.0.1:-5",
    "tcp://127.0.0.1:99999",
    "tcp://[::1",
    "tcp://no\0where:1",
    "tcp://" + "a" * 300 + ":1",
    "127.0.0.1:9",
    "tls://127.0.0.1:9",
    "ws://127.0.0.1:9",
    "wss://127.0.0.1:9",
    "ucx://127.0.0.1:9",
    "inproc://x",
    "ftp://x",
    "gateway://x:1",
    "http://127.0.0.1:9",
]


@pytest.fixture(autouse=True)
def soon(monkeypatch):
    """Let what takes its time take little."""
    monkeypatch.setattr(cluster, "ANSWER_SECONDS", 0.2)


def refused(address, match="no Dask scheduler answers at"):
    with pytest.raises(EvaluationError, match=match) as caught:
        run_all(square, [("a", 1)], print, scheduler=address)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 800


@pytest.mark.parametrize("address", FORMS)
def test_an_address_that_leads_nowhere_is_named(address, capfd):
    refused(address)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("answer", ANSWERS)
def test_a_server_that_is_no_scheduler_is_named(answer, capfd):
    with listener(ANSWERS[answer]) as address:
        refused(address)
    assert capfd.readouterr().err == ""


def test_dask_s_log_is_as_loud_afterwards_as_before():
    logger = logging.getLogger("distributed.client")
    before = logger.level
    refused("tcp://127.0.0.1:9")
    assert logger.level == before


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    refused("tcp://127.0.0.1:9", "needs the extra 'cluster'")


# With real schedulers and workers --------------------------------------------------------------


@pytest.fixture
def patient(monkeypatch):
    """Times that a scheduler of a busy machine keeps to."""
    monkeypatch.setattr(cluster, "ANSWER_SECONDS", 10.0)
    monkeypatch.setattr(parallel, "LOOK_SECONDS", 1.0)
    monkeypatch.setattr(cluster, "WORKER_SECONDS", 60.0)


def run(address, seeds=2, steps=20, **options):
    return evaluate("paper", {"naive": naive}, seeds, steps, scheduler=address, **options)


SLOW = pytest.mark.slow


@SLOW
@pytest.mark.parametrize("workers", [1, 2])
def test_a_sound_cluster_gives_the_bytes_of_one_process(patient, workers):
    with processes(workers=workers) as there:
        table = run(there.address)
    assert table.to_csv() == evaluate("paper", {"naive": naive}, 2, 20).to_csv()


@SLOW
def test_a_worker_s_address_is_no_scheduler(patient):
    from distributed import Client

    with processes() as there, Client(there.address, set_as_default=False) as client:
        client.wait_for_workers(1, timeout=60)
        (worker,) = client.nthreads()
        refused(worker, "a Worker answers, not a scheduler")


@SLOW
def test_a_cluster_without_workers_is_named(patient, monkeypatch):
    monkeypatch.setattr(cluster, "WORKER_SECONDS", 2.0)
    with processes(workers=0) as there:
        refused(there.address, "has had no worker for 2 s")


@SLOW
@pytest.mark.parametrize(
    ("role", "said"),
    [("worker", "of the cluster cannot import rti-cosim"), ("scheduler", "cannot read its tasks")],
)
def test_a_process_without_the_package_is_named(patient, role, said):
    with (
        processes(without=OURS, role=role) as there,
        pytest.raises(EvaluationError, match=said) as caught,
    ):
        run(there.address)
    assert "install the same version" in str(caught.value)


@SLOW
def test_a_worker_of_another_version_is_named(patient, tmp_path):
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package)
    with (tmp_path / "cosim" / "kpis.py").open("a") as file:
        file.write("\n# another version\n")
    with (
        processes(code=tmp_path) as there,
        pytest.raises(EvaluationError, match=r"a worker runs other code \(\w+\)"),
    ):
        run(there.address)


@SLOW
@pytest.mark.parametrize("number", ["SIGKILL", "SIGTERM", "SIGSTOP"])
def test_a_scheduler_that_ends_or_hangs_ends_the_run_and_loses_nothing(patient, number, tmp_path):
    cut = partial(run, seeds=200, steps=500, folder=tmp_path)
    with processes() as there:
        stop = threading.Thread(
            target=lambda: stop_later(tmp_path, there.scheduler, signal.Signals[number])
        )
        stop.start()
        with pytest.raises(EvaluationError, match="is gone or does not answer") as caught:
            cut(there.address)
        stop.join()
    assert "\n" not in str(caught.value)
    finished = units(tmp_path)
    assert 1 <= len(finished) < 200
    table = evaluate("paper", {"naive": naive}, 3, 500, folder=tmp_path)
    assert table.to_csv() == evaluate("paper", {"naive": naive}, 3, 500).to_csv()
    assert units(tmp_path)[: len(finished)] == finished


def units(folder):
    """Whole lines of a folder's finished units."""
    path = folder / FILE
    return path.read_bytes().splitlines(keepends=True) if path.exists() else []


def stop_later(folder, scheduler, number):
    """Send a signal once a unit has been finished."""
    pause = threading.Event()
    while not units(folder):
        pause.wait(0.05)
    scheduler.send_signal(number)


@SLOW
def test_a_worker_that_hangs_is_left_to_the_others(patient, monkeypatch, tmp_path):
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__WORKER_TTL", "3s")
    with processes(workers=2) as there:
        from distributed import Client

        with Client(there.address, set_as_default=False) as client:
            client.wait_for_workers(2, timeout=60)
        stop = threading.Thread(
            target=lambda: stop_later(tmp_path, there.workers[0], signal.SIGSTOP)
        )
        stop.start()
        table = run(there.address, seeds=30, steps=200, folder=tmp_path)
        stop.join()
    assert table.to_csv() == evaluate("paper", {"naive": naive}, 30, 200).to_csv()


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    if shutil.which("openssl") is None:
        pytest.skip("openssl makes the certificate")
    folder = tmp_path_factory.mktemp("tls")
    key, cert = folder / "key.pem", folder / "cert.pem"
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2"]
    subprocess.run(
        [*command, "-subj", "/CN=localhost", "-keyout", str(key), "-out", str(cert)],
        check=True,
        capture_output=True,
    )
    return key, cert


@SLOW
@pytest.mark.parametrize("form", ["tcp", "tls"])
def test_an_encrypted_scheduler_that_one_is_not_set_up_for_is_named(patient, certificate, form):
    key, cert = map(str, certificate)
    options = ("--protocol", "tls", "--tls-ca-file", cert, "--tls-cert", cert, "--tls-key", key)
    with processes(workers=0, options=options) as there:
        assert there.address.startswith("tls://")
        refused(there.address.replace("tls", form, 1))


@SLOW
def test_a_plain_scheduler_asked_for_encryption_is_named(patient):
    with processes(workers=0) as there:
        refused(there.address.replace("tcp", "tls", 1), "TLS")


@SLOW
def test_the_command_says_so_in_a_line_with_exit_code_2(tmp_path):
    with listener(ANSWERS["silent"]) as address:
        words = ["evaluate", "--seeds", "1", "-n", "3", "--scheduler", address, "-o", "out"]
        done = run_cosim(*words, folder=tmp_path, timeout=120)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: no Dask scheduler answers at '{address}': no answer within")
