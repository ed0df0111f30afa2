"""A plant in a process of its own: what crashes or hangs there is an error message here."""

from __future__ import annotations

import json
import multiprocessing
import signal
from collections.abc import Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from cosim import errors
from cosim.errors import CosimError, PlantError
from cosim.lifetime import follow_parent, out_of_reach_of_ctrl_c
from cosim.plant.fmu_plant import FmuPlant
from cosim.plant.resource import Resource
from cosim.plant.snapshot import Snapshot
from cosim.protocols import Step
from cosim.scenario import Scenario

Array = NDArray[np.float64]


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
        self._k = 0
        context = multiprocessing.get_context("spawn")
        self._pipe, remote = context.Pipe()
        self._process = context.Process(
            target=_serve,
            args=(remote, self.scenario.to_dict(), None if fmu is None else str(fmu)),
            daemon=True,
        )
        with out_of_reach_of_ctrl_c():
            self._process.start()
        remote.close()
        about: dict[str, Any] = self._answer()
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
        state = initial_state.tolist() if isinstance(initial_state, np.ndarray) else initial_state
        s = self._call("reset", seed, state)
        self._k = 0
        return np.array(s)

    def step(self, a: Sequence[float] | Array) -> Step:
        """Hold the action a (m,) for one sampling time, as `FmuPlant.step` does."""
        try:
            action = np.asarray(a, dtype=np.float64).tolist()
        except (TypeError, ValueError):
            action = [np.nan]
        s, stage_cost, penalty, disturbance = self._call("step", action)
        self._k += 1
        return Step(np.array(s), stage_cost, penalty, np.array(disturbance))

    def snapshot(self) -> IsolatedSnapshot:
        """Save the state, as `FmuPlant.snapshot` does."""
        return IsolatedSnapshot(self, self._call("snapshot"), self._k)

    def restore(self, snapshot: IsolatedSnapshot) -> Array:
        """Go back to a snapshot of this very plant; return its state (n,)."""
        if snapshot.plant is not self:
            raise PlantError("this snapshot was taken from another plant")
        s = self._call("restore", snapshot.number)
        self._k = snapshot.k
        return np.array(s)

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join(1.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def _call(self, method: str, *arguments: Any) -> Any:
        if self._pipe.closed:
            raise PlantError("the plant is closed")
        while self.dropped:
            self._ask("drop", self.dropped.pop())
        return self._ask(method, *arguments)

    def _ask(self, *request: Any) -> Any:
        try:
            _send(self._pipe, request)
        except OSError:
            self._report_death()
        return self._answer()

    def _answer(self) -> Any:
        try:
            if not self._pipe.poll(self._timeout):
                self._process.kill()
                raise PlantError(
                    f"the plant's process did not answer within {self._timeout:g} s at step "
                    f"{self._k}; it was ended"
                )
            error, answer = _receive(self._pipe)
        except (EOFError, ConnectionError):
            self._report_death()
        if error:
            raise getattr(errors, error, PlantError)(answer)
        return answer

    def _report_death(self) -> NoReturn:
        self._process.join(5.0)
        code = self._process.exitcode
        how = f"by {signal.Signals(-code).name}" if code is not None and code < 0 else f"({code})"
        raise PlantError(
            f"the process of FMU '{self.scenario.plant.fmu}' died {how} at step {self._k}"
        ) from None


def _send(pipe: Connection, message: Any) -> None:
    """Send a message as JSON, in which a float keeps its bits: nothing that is received is run."""
    pipe.send_bytes(json.dumps(message).encode())


def _receive(pipe: Connection) -> Any:
    return json.loads(pipe.recv_bytes())


def _serve(pipe: Connection, scenario: dict[str, Any], fmu: str | None) -> None:
    """Answer the other process's calls until it closes the pipe."""
    # On Windows Ctrl-C reaches it all the same; the parent decides what becomes of it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    follow_parent()  # an FMU that hangs never sees the pipe close
    try:
        plant = FmuPlant(Scenario.from_dict(scenario), fmu)
    except CosimError as error:
        _send(pipe, (type(error).__name__, str(error)))
        return
    about = {
        "units": plant.units,
        "fmi_version": plant.fmi_version,
        "fmu_path": str(plant.fmu_path),
        "fmu_sha256": plant.fmu_sha256,
    }
    _send(pipe, ("", about))
    server = _Server(plant)
    while True:
        try:
            method, *arguments = _receive(pipe)
        except (EOFError, OSError):
            return
        try:
            _send(pipe, ("", getattr(server, method)(*arguments)))
        except CosimError as error:
            _send(pipe, (type(error).__name__, str(error)))


class _Server:
    """The plant and the snapshots that the other process holds by number."""

    def __init__(self, plant: FmuPlant) -> None:
        self._plant = plant
        self._snapshots: dict[int, Snapshot] = {}
        self._last = 0

    def step(self, action: list[float]) -> list[Any]:
        s, stage_cost, penalty, disturbance = self._plant.step(action)
        return [s.tolist(), stage_cost, penalty, disturbance.tolist()]

    def reset(self, seed: int, initial_state: list[float] | None) -> Any:
        return self._plant.reset(seed, initial_state).tolist()

    def snapshot(self) -> int:
        self._last += 1
        self._snapshots[self._last] = self._plant.snapshot()
        return self._last

    def restore(self, number: int) -> Any:
        return self._plant.restore(self._snapshots[number]).tolist()

    def drop(self, number: int) -> None:
        del self._snapshots[number]
