"""Addresses at which no sound Dask cluster answers, and clusters of real processes to ruin."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

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


def silent(connection: socket.socket) -> None:
    """Say nothing."""


def web(connection: socket.socket) -> None:
    with suppress(OSError):
        connection.sendall(b"HTTP/1.0 400 Bad request\r\n\r\n")
        connection.close()


ANSWERS = {answer.__name__: answer for answer in (silent, web)}


@dataclass
class Processes:
    """A scheduler and its workers as processes."""

    address: str = ""
    scheduler: subprocess.Popen[bytes] | None = None
    workers: list[subprocess.Popen[bytes]] = field(default_factory=list)


@contextmanager
def processes(*, workers: int = 1, code: Path = ROOT) -> Iterator[Processes]:
    """A cluster whose workers run the code in a folder."""
    cluster = Processes()
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
        cluster.scheduler = start("scheduler", *where, "--scheduler-file", str(note), path=ROOT)
        cluster.address = _address(note)
        for _ in range(workers):
            words = (cluster.address, "--nthreads", "1", "--no-nanny", "--no-dashboard")
            cluster.workers.append(start("worker", *words, path=code))
        yield cluster


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
