"""A plant in a process of its own: what crashes or hangs there is an error message here."""

from __future__ import annotations

import json
import multiprocessing
import signal
import struct
import tomllib
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from cosim import errors
from cosim.errors import CosimError, PlantError
from cosim.lifetime import follow_parent
from cosim.plant.fmu_plant import FmuPlant
from cosim.plant.resource import Resource
from cosim.plant.snapshot import Snapshot
from cosim.protocols import Step
from cosim.scenario import Scenario

Array = NDArray[np.float64]
_RESET, _STEP, _SNAPSHOT, _RESTORE, _RELEASE = b"rspgx"
_WORD = struct.Struct("<Q")


class IsolatedSnapshot:
    """A state that the plant's process keeps; dropped there when this object is dropped."""

    def __init__(self, plant: IsolatedPlant, number: int, k: int) -> None:
        self.plant = plant
        self.number = number
        self.k = k

    def __del__(self) -> None:
        """Let the process drop the state with its next call."""
        self.plant.dropped.append(self.number)


class IsolatedPlant(Resource):
    """`FmuPlant` in a spawned process: the same calls, except `serialise`, at about 0.1 ms a step.

    Use it for foreign FMUs that may crash. Raises the errors of `FmuPlant`, and PlantError if the
    process dies or does not answer within `timeout` s; it is over then, a new one may be made.
    """

    def __init__(
        self,
        scenario: Scenario | str | Path,
        fmu: str | Path | None = None,
        timeout: float = 60.0,
    ) -> None:
        self.scenario = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
        self.dropped: list[int] = []
        self._timeout = timeout
        self._n = len(self.scenario.plant.states)
        self._k = 0
        context = multiprocessing.get_context("spawn")
        self._pipe, remote = context.Pipe()
        self._process = context.Process(
            target=_serve,
            args=(remote, self.scenario.to_toml(), None if fmu is None else str(fmu)),
            daemon=True,
        )
        self._process.start()
        remote.close()
        about: dict[str, Any] = json.loads(self._answer())
        self.units: dict[str, str] = about["units"]
        self.fmi_version: str = about["fmi_version"]
        self.fmu_path = Path(about["fmu_path"])
        self.fmu_sha256: str = about["fmu_sha256"]

    @property
    def k(self) -> int:
        """Number of steps since the reset."""
        return self._k

    @property
    def time(self) -> float:
        """Time k·h in s."""
        return self._k * self.scenario.sampling_time

    def reset(self, seed: int, initial_state: Sequence[float] | Array | None = None) -> Array:
        """Start again at k = 0, as `FmuPlant.reset` does."""
        document = {"seed": seed, "initial_state": _plain(initial_state)}
        s = _array(self._call(_RESET, json.dumps(document).encode()))
        self._k = 0
        return s

    def step(self, a: Sequence[float] | Array) -> Step:
        """Hold the action a (m,) for one sampling time, as `FmuPlant.step` does."""
        try:
            action = np.asarray(a, dtype=np.float64)
        except (TypeError, ValueError):
            action = np.array([np.nan])
        values = _array(self._call(_STEP, action.tobytes()))
        self._k += 1
        n = self._n
        return Step(values[:n], float(values[n]), float(values[n + 1]), values[n + 2 :])

    def snapshot(self) -> IsolatedSnapshot:
        """Save the state, as `FmuPlant.snapshot` does."""
        number = _WORD.unpack(self._call(_SNAPSHOT, b""))[0]
        return IsolatedSnapshot(self, number, self._k)

    def restore(self, snapshot: IsolatedSnapshot) -> Array:
        """Go back to a snapshot of this very plant; return its state (n,)."""
        if snapshot.plant is not self:
            raise PlantError("this snapshot was taken from another plant")
        s = _array(self._call(_RESTORE, _WORD.pack(snapshot.number)))
        self._k = snapshot.k
        return s

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join(1.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _call(self, operation: int, payload: bytes) -> bytes:
        if self._pipe.closed:
            raise PlantError("the plant is closed")
        while self.dropped:
            self._ask(_RELEASE, _WORD.pack(self.dropped.pop()))
        return self._ask(operation, payload)

    def _ask(self, operation: int, payload: bytes) -> bytes:
        try:
            self._pipe.send_bytes(bytes([operation]) + payload)
        except OSError:
            self._report_death()
        return self._answer()

    def _answer(self) -> bytes:
        try:
            if not self._pipe.poll(self._timeout):
                self._process.kill()
                raise PlantError(
                    f"the plant's process did not answer within {self._timeout:g} s at step "
                    f"{self._k}; it was ended"
                )
            answer = self._pipe.recv_bytes()
        except (EOFError, ConnectionError):
            self._report_death()
        if answer[:1] == b"+":
            return answer[1:]
        name, _, message = answer[1:].decode().partition(":")
        raise getattr(errors, name, PlantError)(message)

    def _report_death(self) -> NoReturn:
        self._process.join(5.0)
        code = self._process.exitcode
        how = f"by {signal.Signals(-code).name}" if code is not None and code < 0 else f"({code})"
        raise PlantError(
            f"the process of FMU '{self.scenario.plant.fmu}' died {how} at step {self._k}"
        ) from None


def _array(data: bytes) -> Array:
    return np.frombuffer(data, dtype=np.float64).copy()


def _plain(state: Sequence[float] | Array | None) -> Any:
    return state.tolist() if isinstance(state, np.ndarray) else state


def _serve(pipe: Connection, scenario: str, fmu: str | None) -> None:
    """Answer the other process's calls until it closes the pipe."""
    # Ctrl-C reaches the whole group; the parent decides what becomes of it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    follow_parent()  # an FMU that hangs never sees the pipe close
    try:
        plant = FmuPlant(Scenario.from_dict(tomllib.loads(scenario)), fmu)
    except CosimError as error:
        pipe.send_bytes(_error(error))
        return
    about = {
        "units": plant.units,
        "fmi_version": plant.fmi_version,
        "fmu_path": str(plant.fmu_path),
        "fmu_sha256": plant.fmu_sha256,
    }
    pipe.send_bytes(b"+" + json.dumps(about).encode())
    server = _Server(plant)
    while True:
        try:
            request = pipe.recv_bytes()
        except (EOFError, OSError):
            return
        try:
            pipe.send_bytes(b"+" + server.handle(request[0], request[1:]))
        except CosimError as error:
            pipe.send_bytes(_error(error))


def _error(error: CosimError) -> bytes:
    return f"-{type(error).__name__}:{error}".encode()


class _Server:
    """The plant and the snapshots that the other process holds by number."""

    def __init__(self, plant: FmuPlant) -> None:
        self._plant = plant
        self._snapshots: dict[int, Snapshot] = {}
        self._last = 0

    def handle(self, operation: int, payload: bytes) -> bytes:
        if operation == _STEP:
            s, cost, penalty, disturbance = self._plant.step(np.frombuffer(payload))
            return np.concatenate([s, [cost, penalty], disturbance]).tobytes()
        if operation == _RESET:
            document = json.loads(payload)
            return self._plant.reset(document["seed"], document["initial_state"]).tobytes()
        if operation == _SNAPSHOT:
            self._last += 1
            self._snapshots[self._last] = self._plant.snapshot()
            return _WORD.pack(self._last)
        number = _WORD.unpack(payload)[0]
        if operation == _RESTORE:
            return self._plant.restore(self._snapshots[number]).tobytes()
        del self._snapshots[number]
        return b""
