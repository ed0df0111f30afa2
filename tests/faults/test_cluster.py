"""Whatever a Dask address leads to, a run ends, within a time, in results or in one clear line."""

import asyncio
import json
import os
import shutil
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest

from controllers.factories import naive
from cosim import evaluate
from cosim import workers as engine
from cosim.core.errors import EvaluationError

pytest.importorskip("distributed")
ROOT = Path(__file__).parents[2]
MAIN = "from distributed.cli.dask_{role} import main; main()"
PACKAGES = ("fmus", "cosim", "controllers", "learning")


@contextmanager
def listener(answer: Callable[[socket.socket], None]) -> Iterator[str]:
    """Address of a server on loopback that answers each connection in its own way."""
    with socket.create_server(("127.0.0.1", 0)) as server, ExitStack() as open_ones:

        def serve() -> None:
            with suppress(OSError):
                while True:
                    connection, _ = server.accept()
                    open_ones.callback(connection.close)
                    answer(connection)

        threading.Thread(target=serve, daemon=True).start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"


def web(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.sendall(b"HTTP/1.0 400 Bad request\r\n\r\n")
        connection.close()


@contextmanager
def processes(*, workers: int = 1, code: Path = ROOT) -> Iterator[tuple[str, subprocess.Popen]]:
    """Address and scheduler of a cluster whose workers run the code in a folder."""
    with tempfile.TemporaryDirectory(prefix="cosim-dask-") as folder, ExitStack() as running:

        def start(which: str, *words: str, path: Path) -> subprocess.Popen[bytes]:
            process = subprocess.Popen(
                [sys.executable, "-c", MAIN.format(role=which), *words],
                cwd=folder,
                env=os.environ | {"PYTHONPATH": str(path), "PYTHONWARNINGS": "ignore"},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            running.callback(_end, process)
            return process

        note = Path(folder) / "scheduler.json"
        where = ("--host", "127.0.0.1", "--port", "0", "--no-dashboard")
        scheduler = start("scheduler", *where, "--scheduler-file", str(note), path=ROOT)
        address = _address(note)
        for _ in range(workers):
            start("worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard", path=code)
        yield address, scheduler


def _end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait()


def _address(note: Path) -> str:
    deadline = time.monotonic() + 60.0
    while time.monotonic() < deadline:
        with suppress(OSError, ValueError):
            return str(json.loads(note.read_text())["address"])
        time.sleep(0.05)
    raise TimeoutError("the scheduler did not start")


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
@pytest.mark.parametrize("address", ["nonsense", "tcp://127.0.0.1:9"])
def test_an_address_that_leads_nowhere_is_named(address):
    refused(address)


@pytest.mark.usefixtures("soon")
def test_a_server_that_is_no_scheduler_is_named():
    with listener(web) as address:
        refused(address)


def test_without_dask_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(EvaluationError, match="cluster"):
        run("tcp://127.0.0.1:9")


# With real schedulers and workers --------------------------------------------------------------

SLOW = pytest.mark.slow


@SLOW
def test_a_cluster_gives_the_bytes_of_one_process_in_a_notebook_too():
    async def cell(address):  # an event loop runs already
        return run(address).to_csv()

    with processes(workers=2) as (address, _):
        table = asyncio.run(cell(address))
    assert table == evaluate("paper", {"naive": naive}, 2, 20).to_csv()


@SLOW
def test_a_cluster_without_workers_is_named(monkeypatch):
    monkeypatch.setattr(engine, "WORKER_SECONDS", 2.0)
    with processes(workers=0) as (address, _):
        refused(address)


@SLOW
def test_a_worker_of_another_version_is_named(tmp_path):
    for package in PACKAGES:
        shutil.copytree(ROOT / package, tmp_path / package)
    with (tmp_path / "cosim" / "core" / "simulation.py").open("a") as file:
        file.write("\n# another version\n")
    with processes(code=tmp_path) as (address, _):
        refused(address)


@SLOW
def test_a_scheduler_that_ends_ends_the_run_in_a_line():
    def stop_later(scheduler):
        time.sleep(5.0)
        scheduler.kill()

    with processes() as (address, scheduler):
        stop = threading.Thread(target=stop_later, args=(scheduler,))
        stop.start()
        with pytest.raises(EvaluationError) as caught:
            run(address, seeds=4000, steps=5000)
        stop.join()
    assert "\n" not in str(caught.value)
