"""Times a plant step against the same work done through fmpy's own conveniences."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np
from fmpy import instantiate_fmu, simulate_fmu

from cosim.plant.fmu_plant import FmuPlant
from cosim.scenario import Scenario

REPETITIONS = 9
TARGETS = {
    "fmpy convenience methods": 1.7,
    "fmpy simulate_fmu": 100.0,
    "reset": 3.0,
    "snapshot and restore": 2.0,
}


def measure(
    scenario: Scenario | str | Path, fmu: str | Path | None = None, steps: int = 5000
) -> dict[str, Any]:
    """Time the plant and its alternatives, interleaved; return rows with µs and ratios.

    One step sets the inputs, reads stage cost and disturbances, steps by the sampling time and
    reads the states. `FmuPlant.step` also checks the action, computes the penalty and returns
    fresh arrays. `simulate_fmu` is called once per step, as a closed loop has to: as documented,
    on the unpacked FMU from the present state, and then with all that can be kept (instance, model
    description, no validation); and once for a whole open-loop run. The ratio of an alternative is
    its time over `FmuPlant.step`'s; `target` is its bound, at least for alternatives to a step and
    at most for reset and snapshot. Ratios are medians of the repetitions' ratios.
    """
    with FmuPlant(scenario, fmu) as plant:
        timers = _timers(plant, steps)
        seconds: dict[str, list[float]] = {name: [] for name in timers}
        for _ in range(REPETITIONS):
            for name, timer in timers.items():
                seconds[name].append(timer())
        base = seconds["FmuPlant.step"]
        rows = [_row(name, values, base) for name, values in seconds.items()]
        return {
            "scenario": plant.scenario.name,
            "fmu": plant.fmu_path.name,
            "fmi_version": plant.fmi_version,
            "steps": steps,
            "repetitions": REPETITIONS,
            "rows": rows,
        }


def _row(name: str, values: list[float], base: list[float]) -> dict[str, Any]:
    ratio = median(value / step for value, step in zip(values, base, strict=True))
    target = TARGETS.get(name)
    slower_is_better = name.startswith("fmpy")
    text = f"{ratio:.2f}"
    met = None
    if target is not None:
        met = ratio >= target if slower_is_better else ratio <= target
        text += f" ({'≥' if slower_is_better else '≤'} {target:g}: {'met' if met else 'MISSED'})"
    return {
        "name": name,
        "median_us": 1e6 * median(values),
        "minimum_us": 1e6 * min(values),
        "ratio": ratio,
        "target": target,
        "met": met,
        "ratio_text": text,
    }


def _timers(plant: FmuPlant, steps: int) -> dict[str, Callable[[], float]]:
    """Functions that do the work `steps` times (less where it is slow) and return s per step."""
    action = plant.scenario.reference_action
    slave = _Fmpy(plant)

    def step() -> float:
        plant.reset(1)
        begin = perf_counter()
        for _ in range(steps):
            plant.step(action)
        return (perf_counter() - begin) / steps

    def reset() -> float:
        begin = perf_counter()
        for _ in range(steps):
            plant.reset(1)
        return (perf_counter() - begin) / steps

    def snapshot() -> float:
        plant.reset(1)
        plant.step(action)
        begin = perf_counter()
        for _ in range(steps):
            plant.restore(plant.snapshot())
        return (perf_counter() - begin) / steps

    return {
        "FmuPlant.step": step,
        "fmpy convenience methods": lambda: slave.convenience(steps),
        "fmpy simulate_fmu": lambda: slave.plain_calls(max(10, steps // 500)),
        "fmpy simulate_fmu, kept instance": lambda: slave.kept_calls(max(20, steps // 100)),
        "fmpy simulate_fmu, open loop": lambda: slave.open_loop(max(100, steps // 10)),
        "reset": reset,
        "snapshot and restore": snapshot,
    }


class _Fmpy:
    """The same plant through fmpy's public interface."""

    def __init__(self, plant: FmuPlant) -> None:
        table = plant.scenario.plant
        self._unpacked = plant.unpacked
        self._h = plant.scenario.sampling_time
        variables = self._unpacked.description.modelVariables
        references = {variable.name: variable.valueReference for variable in variables}
        self._action = plant.scenario.reference_action.tolist()
        # simulate_fmu warns of every input that it is not given.
        others = {
            variable.name: float(variable.start)
            for variable in variables
            if variable.causality == "input"
            and variable.type in ("Real", "Float64")
            and variable.name not in table.actions
        }
        self._signal_names = [*table.actions, *others]
        self._signal_values = [*self._action, *others.values()]
        self._start_names = list(table.mapping.initial_state)
        self._state_names = list(table.states) if self._start_names else []
        self._state = list(table.initial_state) if self._start_names else []
        self._inputs = [references[name] for name in table.actions]
        self._outputs = [references[name] for name in (table.stage_cost, *table.disturbances)]
        self._states = [references[name] for name in table.states]
        self._read = [table.stage_cost, *table.disturbances, *table.states]
        self._is_fmi2 = plant.fmi_version.startswith("2")

    def _instance(self) -> Any:
        slave = instantiate_fmu(
            str(self._unpacked.folder), self._unpacked.description, fmi_type="CoSimulation"
        )
        if self._is_fmi2:
            slave.setupExperiment(startTime=0.0)
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        return slave

    def convenience(self, steps: int) -> float:
        slave = self._instance()
        get = slave.getReal if self._is_fmi2 else slave.getFloat64
        set_ = slave.setReal if self._is_fmi2 else slave.setFloat64
        begin = perf_counter()
        for k in range(steps):
            set_(self._inputs, self._action)
            get(self._outputs)
            slave.doStep(k * self._h, self._h)
            get(self._states)
        seconds = (perf_counter() - begin) / steps
        slave.freeInstance()
        return seconds

    def _signals(self, start: float) -> Any:
        fields = [("time", float), *((name, float) for name in self._signal_names)]
        signals = np.zeros(1, dtype=fields)
        signals[0] = (start, *self._signal_values)
        return signals

    def plain_calls(self, steps: int) -> float:
        state = self._state
        begin = perf_counter()
        for k in range(steps):
            result = simulate_fmu(
                str(self._unpacked.folder),
                start_time=k * self._h,
                stop_time=(k + 1) * self._h,
                output_interval=self._h,
                fmi_type="CoSimulation",
                start_values=dict(zip(self._start_names, state, strict=True)),
                input=self._signals(k * self._h),
                output=self._read,
            )
            state = [float(result[name][-1]) for name in self._state_names]
        return (perf_counter() - begin) / steps

    def kept_calls(self, steps: int) -> float:
        slave = self._instance()
        begin = perf_counter()
        for k in range(steps):
            simulate_fmu(
                str(self._unpacked.folder),
                validate=False,
                start_time=k * self._h,
                stop_time=(k + 1) * self._h,
                output_interval=self._h,
                fmi_type="CoSimulation",
                input=self._signals(k * self._h),
                output=self._read,
                model_description=self._unpacked.description,
                fmu_instance=slave,
                initialize=False,
                terminate=False,
            )
        seconds = (perf_counter() - begin) / steps
        slave.freeInstance()
        return seconds

    def open_loop(self, steps: int) -> float:
        begin = perf_counter()
        simulate_fmu(
            str(self._unpacked.folder),
            validate=False,
            stop_time=steps * self._h,
            output_interval=self._h,
            fmi_type="CoSimulation",
            input=self._signals(0.0),
            output=self._read,
            model_description=self._unpacked.description,
        )
        return (perf_counter() - begin) / steps
