"""A plant step beside the same work done through fmpy's own conveniences."""

import numpy as np
from fmpy import instantiate_fmu, simulate_fmu

from benchmarks.measuring import clock, figure
from cosim import FmuPlant

REPETITIONS = 9
REFERENCES = {
    "fmpy's convenience methods": 1.7,
    "simulate_fmu": 100.0,
    "simulate_fmu, kept instance": None,
    "simulate_fmu, open loop": None,
}
"""References of a step, and how many times as long each is to take at least."""
COSTS = {"reset": 1 / 3, "snapshot and restore": 1 / 2}
"""What a step is the reference of, and its least ratio."""


def measure(scenario, steps):
    """Time steps and their alternatives in turn.

    A step sets the inputs, reads stage cost and disturbances, steps, and reads the states;
    `FmuPlant.step` also checks the action, computes the penalty and returns fresh arrays.
    """
    with FmuPlant(scenario) as plant:
        action, fmpy = scenario.reference_action, ByFmpy(plant)

        def repeated(work):
            plant.reset(1)
            plant.step(action)
            begin = clock()
            for _ in range(steps):
                work()
            return (clock() - begin) / steps

        timers = {
            "FmuPlant.step": lambda: repeated(lambda: plant.step(action)),
            "fmpy's convenience methods": lambda: fmpy.convenience(steps),
            "simulate_fmu": lambda: fmpy.plain_calls(max(10, steps // 500)),
            "simulate_fmu, kept instance": lambda: fmpy.kept_calls(max(20, steps // 100)),
            "simulate_fmu, open loop": lambda: fmpy.open_loop(max(100, steps // 10)),
            "reset": lambda: repeated(lambda: plant.reset(1)),
            "snapshot and restore": lambda: repeated(lambda: plant.restore(plant.snapshot())),
        }
        seconds = {name: [] for name in timers}
        for _ in range(REPETITIONS):
            for name, timer in timers.items():
                seconds[name].append(timer())
    step = seconds["FmuPlant.step"]
    rows = [
        figure("FmuPlant.step", step, name, seconds[name], at_least=bound)
        for name, bound in REFERENCES.items()
    ]
    return rows + [
        figure(name, seconds[name], "FmuPlant.step", step, at_least=bound)
        for name, bound in COSTS.items()
    ]


class ByFmpy:
    """The plant at its reference action by what fmpy offers; each method returns s per step."""

    def __init__(self, plant):
        table = plant.scenario.plant
        self.folder, self.description = str(plant.unpacked.folder), plant.unpacked.description
        self.h = plant.scenario.sampling_time
        variables = self.description.modelVariables
        references = {variable.name: variable.valueReference for variable in variables}
        self.action = plant.scenario.reference_action.tolist()
        # simulate_fmu warns of every input that it is not given.
        others = {
            v.name: float(v.start)
            for v in variables
            if v.causality == "input"
            and v.type in ("Real", "Float64")
            and v.name not in table.actions
        }
        fields = [("time", float), *((name, float) for name in (*table.actions, *others))]
        self.signals = np.array([(0.0, *self.action, *others.values())], dtype=fields)
        self.start = dict(zip(table.mapping.initial_state, table.initial_state, strict=False))
        self.states = list(table.states)
        self.inputs = [references[name] for name in table.actions]
        self.outputs = [references[name] for name in (table.stage_cost, *table.disturbances)]
        self.state_references = [references[name] for name in table.states]
        self.read = [table.stage_cost, *table.disturbances, *table.states]
        self.is_fmi2 = plant.fmi_version.startswith("2")

    def instance(self):
        slave = instantiate_fmu(self.folder, self.description, fmi_type="CoSimulation")
        if self.is_fmi2:
            slave.setupExperiment(startTime=0.0)
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        return slave

    def convenience(self, steps):
        """An instance's own methods, with lists."""
        slave = self.instance()
        get = slave.getReal if self.is_fmi2 else slave.getFloat64
        set_ = slave.setReal if self.is_fmi2 else slave.setFloat64
        begin = clock()
        for k in range(steps):
            set_(self.inputs, self.action)
            get(self.outputs)
            slave.doStep(k * self.h, self.h)
            get(self.state_references)
        seconds = (clock() - begin) / steps
        slave.freeInstance()
        return seconds

    def simulate(self, k, steps=1, **options):
        self.signals["time"] = k * self.h
        return simulate_fmu(
            self.folder, start_time=k * self.h, stop_time=(k + steps) * self.h,
            output_interval=self.h, fmi_type="CoSimulation", input=self.signals, output=self.read,
            **options,
        )  # fmt: skip

    def plain_calls(self, steps):
        """`simulate_fmu` a step, as documented: on the unpacked FMU from the present state."""
        start, begin = dict(self.start), clock()
        for k in range(steps):
            result = self.simulate(k, start_values=start)
            for name, state in zip(start, self.states, strict=False):
                start[name] = float(result[state][-1])
        return (clock() - begin) / steps

    def kept_calls(self, steps):
        """`simulate_fmu` a step with all that can be kept: instance, description, no validation."""
        slave, begin = self.instance(), clock()
        kept = {"validate": False, "model_description": self.description, "fmu_instance": slave}
        for k in range(steps):
            self.simulate(k, initialize=False, terminate=False, **kept)
        seconds = (clock() - begin) / steps
        slave.freeInstance()
        return seconds

    def open_loop(self, steps):
        """One `simulate_fmu` of a whole run, which no controller can act in."""
        begin = clock()
        self.simulate(0, steps, validate=False, model_description=self.description)
        return (clock() - begin) / steps
