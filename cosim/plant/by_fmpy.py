"""The same plant through fmpy's public interface: what `FmuPlant` is measured against."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from fmpy import instantiate_fmu, simulate_fmu

from cosim.plant.fmu_plant import FmuPlant


class ByFmpy:
    """The plant of a scenario, at its reference action, by what fmpy offers.

    Each method takes `steps` steps and returns the seconds of one, by the `clock` that is given. A
    step is set inputs, read stage cost and disturbances, step by the sampling time, read states.
    """

    def __init__(self, plant: FmuPlant, clock: Callable[[], float]) -> None:
        table = plant.scenario.plant
        self._clock = clock
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
        """An instance's own methods, with lists."""
        slave = self._instance()
        get = slave.getReal if self._is_fmi2 else slave.getFloat64
        set_ = slave.setReal if self._is_fmi2 else slave.setFloat64
        begin = self._clock()
        for k in range(steps):
            set_(self._inputs, self._action)
            get(self._outputs)
            slave.doStep(k * self._h, self._h)
            get(self._states)
        seconds = (self._clock() - begin) / steps
        slave.freeInstance()
        return seconds

    def _signals(self, start: float) -> Any:
        fields = [("time", float), *((name, float) for name in self._signal_names)]
        signals = np.zeros(1, dtype=fields)
        signals[0] = (start, *self._signal_values)
        return signals

    def plain_calls(self, steps: int) -> float:
        """`simulate_fmu` a step, as documented: on the unpacked FMU from the present state."""
        state = self._state
        begin = self._clock()
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
        return (self._clock() - begin) / steps

    def kept_calls(self, steps: int) -> float:
        """`simulate_fmu` a step with all that can be kept: instance, description, no validation."""
        slave = self._instance()
        begin = self._clock()
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
        seconds = (self._clock() - begin) / steps
        slave.freeInstance()
        return seconds

    def open_loop(self, steps: int) -> float:
        """One `simulate_fmu` of a whole run, which no controller can act in."""
        begin = self._clock()
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
        return (self._clock() - begin) / steps
