"""Reads a stored run back, from a folder, a CSV file or a recording."""

from __future__ import annotations

from pathlib import Path

from cosim.comparison import RunSignals
from cosim.errors import ComparisonError, ScenarioError
from cosim.scenario import Scenario
from cosim.signals import clocked
from cosim.trajectory import Signal, read_signals

TRAJECTORY, SCENARIO = "trajectory.csv", "scenario.toml"


def load_run(path: str | Path) -> RunSignals:
    """Load a run from a folder that holds trajectory.csv, from such a CSV, or from a `.rrd` file.

    Raises
    ------
    ComparisonError : nothing of the kind there; TrajectoryError, RecordingError : not readable.
    """
    path = Path(path)
    if path.is_dir():
        path = path / TRAJECTORY
    if not path.is_file():
        raise ComparisonError(f"there is no run at '{path}'; give a run's folder, CSV or .rrd")
    if path.suffix != ".rrd":
        return RunSignals(str(path), *read_signals(path), _bounds(path.parent / SCENARIO))
    from cosim.recording.reader import read_recording  # noqa: PLC0415 - half a second, for .rrd only

    recording = read_recording(path)
    signals = {
        name: Signal(name, recording.units[name], values)
        for name, values in recording.signals.items()
        if values.ndim == 1 and name not in clocked()
    }
    return RunSignals(str(path), signals, recording.status)


def _bounds(path: Path) -> dict[str, tuple[float, float]]:
    """Bounds of states and actions by name; none where no readable scenario lies beside a run."""
    try:
        return Scenario.load(path).limits if path.is_file() else {}
    except ScenarioError:
        return {}
