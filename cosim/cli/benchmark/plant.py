"""Times a plant step beside the same work done through fmpy's own conveniences."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cosim.cli.benchmark.figures import clock, figure
from cosim.plant import FmuPlant
from cosim.plant.by_fmpy import ByFmpy
from cosim.scenario import Scenario

REPETITIONS = 9
STEP = "FmuPlant.step"
REFERENCES = {
    "fmpy's convenience methods": 1.7,
    "simulate_fmu": 100.0,
    "simulate_fmu, kept instance": None,
    "simulate_fmu, open loop": None,
}
"""What a step is measured against, and how many times as long it is to take at least."""
COSTS = {"reset": 1 / 3, "snapshot and restore": 1 / 2}
"""What a step is the reference of, and how many times as long it is to take at least."""


def measure(
    scenario: Scenario | str | Path, fmu: str | Path | None = None, steps: int = 5000
) -> dict[str, Any]:
    """Time a plant step and its alternatives, interleaved, by repetition.

    `FmuPlant.step` does what `ByFmpy` does, checks the action, computes the penalty and returns
    fresh arrays.
    """
    with FmuPlant(scenario, fmu) as plant:
        timers = _timers(plant, steps)
        seconds: dict[str, list[float]] = {name: [] for name in timers}
        for _ in range(REPETITIONS):
            for name, timer in timers.items():
                seconds[name].append(timer())
        step = seconds[STEP]
        rows = [
            figure(STEP, step, name, seconds[name], at_least=bound)
            for name, bound in REFERENCES.items()
        ]
        rows += [
            figure(name, seconds[name], STEP, step, at_least=bound) for name, bound in COSTS.items()
        ]
        return {
            "scenario": plant.scenario.name,
            "fmu": plant.fmu_path.name,
            "fmi_version": plant.fmi_version,
            "steps": steps,
            "repetitions": REPETITIONS,
            "rows": rows,
        }


def _timers(plant: FmuPlant, steps: int) -> dict[str, Callable[[], float]]:
    """Functions that do the work `steps` times (less where it is slow) and return s per step."""
    action = plant.scenario.reference_action
    by_fmpy = ByFmpy(plant, clock)

    def repeated(work: Callable[[], object]) -> float:
        plant.reset(1)
        plant.step(action)
        begin = clock()
        for _ in range(steps):
            work()
        return (clock() - begin) / steps

    return {
        STEP: lambda: repeated(lambda: plant.step(action)),
        "fmpy's convenience methods": lambda: by_fmpy.convenience(steps),
        "simulate_fmu": lambda: by_fmpy.plain_calls(max(10, steps // 500)),
        "simulate_fmu, kept instance": lambda: by_fmpy.kept_calls(max(20, steps // 100)),
        "simulate_fmu, open loop": lambda: by_fmpy.open_loop(max(100, steps // 10)),
        "reset": lambda: repeated(lambda: plant.reset(1)),
        "snapshot and restore": lambda: repeated(lambda: plant.restore(plant.snapshot())),
    }
