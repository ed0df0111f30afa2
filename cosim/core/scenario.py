"""The scenario: one validated document of plant, cost, bounds and controller."""

from __future__ import annotations

import copy
import hashlib
import json
import math
import re
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import tomli_w
from numpy.typing import ArrayLike, NDArray
from pydantic import BaseModel, ConfigDict, Field, model_validator

from cosim.core.errors import ScenarioError
from cosim.core.files import read_toml
from cosim.core.modules import import_from
from cosim.core.result import Shown
from cosim.core.signal_file import read_signal_file
from cosim.core.validation import SchemaVersion, instead, suggestion, validated

Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1)]
Names = Annotated[tuple[Name, ...], Field(strict=False)]
Numbers = Annotated[tuple[Number, ...], Field(strict=False)]
Limits = Annotated[tuple[float, ...], Field(strict=False)]
NonNegatives = Annotated[tuple[NonNegative, ...], Field(strict=False)]


class Table(BaseModel):
    """A table whose fields are all known, checked strictly and never changed."""

    model_config = ConfigDict(
        # A scenario is shared by plants, controllers and caches, and has a hash.
        frozen=True,
        # A misspelt field would else leave its default in force without a word.
        extra="forbid",
        # No text becomes a number, and no fraction a whole one.
        strict=True,
        populate_by_name=True,
    )


class MappingTable(Table):
    """FMU variables that a reset writes; each is optional.

    A variable that is left out is not written: without `seed`, for instance, the FMU draws its own
    noise.
    """

    initial_state: Names = ()
    """One start parameter per state."""
    seed: Names = ()
    """Variables of the seed, low 32 bits first; a 64-bit one takes all of it and ends the list."""
    sampling_time: Name | None = None
    """Parameter of the disturbances' grid, in s."""
    stochastic: Name | None = None
    """Boolean parameter: false gives the nominal plant."""
    law: Name | None = None
    """Parameter of the law, which takes the number that `law_codes` gives."""
    law_codes: dict[str, int] = {}
    """The FMU's number of each law by its name."""
    nominal: Names = ()
    """One parameter per disturbance for its nominal value."""
    ranges: Names = ()
    """One parameter per disturbance for its half width or standard deviation."""
    time_constant: Names | None = None
    """One parameter per disturbance for the time constant of its filter, in s."""


class ChangeTable(Table):
    """A change of the plant in operation, which controllers and rules are not told of."""

    time: Positive
    """Time since the reset in s; it takes effect at the first sample at or after it."""
    parameters: Annotated[dict[str, Number], Field(min_length=1)]
    """Tunable parameters of the FMU and their values from then on."""


def is_file(fmu: str) -> bool:
    """Whether an FMU is given by its path, and not by the name of a shipped one."""
    path = Path(fmu)
    return path.suffix == ".fmu" or len(path.parts) > 1


class PlantTable(Table):
    """The FMU and the map from its variables to states, actions, disturbances and stage cost.

    Values are in the FMU's units.
    """

    fmu: Name
    """A shipped FMU (`evaporator`, `evaporator_fmi3`) or a path relative to the scenario's file."""
    states: Annotated[Names, Field(min_length=1)]
    """Names of the n variables that are the state."""
    actions: Annotated[Names, Field(min_length=1)]
    """Names of the m inputs that the controller sets."""
    disturbances: Names = ()
    """Names of the p outputs that say which disturbance was realised."""
    stage_cost: Name
    """Name of the output ℓ(x, u, d), without penalty."""
    initial_state: Numbers
    """State at k = 0, (n,)."""
    parameters: dict[str, float | bool] = {}
    """Further start values, by variable, that each reset writes."""
    communication_step: Positive | None = None
    """Communication step in s, a divisor of the sampling time; without it the sampling time."""
    outputs: Literal["before-step", "after-step"] | None = None
    """When stage cost and disturbances of a sample are read.

    `before-step`: at its begin, after the actions are set, which asks for an FMU whose outputs
    follow them at once. `after-step`: after its (first) communication step, for an FMU whose
    doStep computes them. Without it the plant finds it out, each output for itself.
    """
    start_time: Number | None = None
    """The FMU's time at k = 0 in s; without it that of its default experiment, else 0."""
    stop_time: Number | None = None
    """The FMU's time in s beyond which no step goes; without it the FMU is told of none."""
    tolerance: Positive | None = None
    """Relative tolerance of the FMU's solver; without it that of its default experiment."""
    changes: Annotated[tuple[ChangeTable, ...], Field(strict=False)] | None = None
    """Tables `[[plant.changes]]`: what changes in mid run, times increasing."""
    model: Annotated[str, Field(pattern=r"^[\w.]+:\w+$")] | None = None
    """Model of the plant for its optimum, `module:factory`, where the controller's is another."""
    mapping: MappingTable = MappingTable()
    """Table `[plant.mapping]`."""


class DisturbanceTable(Table):
    """Law of the disturbances: drawn anew each sample and held, or drawn, filtered and held.

    With a time constant T a disturbance is nominal + range·x_k, the draws w_k filtered:
    x_k = φ x_{k−1} + √(1 − φ²) w_k with φ = exp(−h/T), from x = w in the first sample. Mean and
    standard deviation are those of the draws, the autocorrelation over n samples is φⁿ. A uniform
    law then names the law of the draws: the value goes beyond nominal ± range at times.
    """

    law: Literal["uniform", "normal", "none"] = "none"
    """Uniform about the nominal value, normal about it, or that value itself."""
    nominal: Numbers = ()
    """Nominal values, (p,)."""
    ranges: NonNegatives = ()
    """Half widths of the uniform law, standard deviations of the normal one, (p,)."""
    time_constant: NonNegatives | None = None
    """Time constants of the filters in s, (p,); 0, or left out: drawn anew each sample."""

    @property
    def coloured(self) -> bool:
        """Whether the disturbance of a sample depends on those of the samples before it."""
        return self.law != "none" and any(self.time_constant or ())


class BoundsTable(Table):
    """Bounds of the states (soft: the penalty) and of the actions (hard: the actuators)."""

    state_lower: Limits
    """x_l, (n,); −∞ where there is none."""
    state_upper: Limits
    """x_u, (n,); ∞ where there is none."""
    action_lower: Numbers
    """u_l, (m,)."""
    action_upper: Numbers
    """u_u, (m,)."""


class PenaltyTable(Table):
    """Weights b and B of the violation v: Σᵢ bᵢ vᵢ + Bᵢ vᵢ² per sample."""

    linear: NonNegatives
    """b, (n,)."""
    quadratic: NonNegatives
    """B, (n,)."""


class ExplorationTable(Table):
    """ε-greedy exploration: `additive` a = sat(π(s)+e), `literal` a = sat(e), e ~ N(0, diag σ²)."""

    kind: Literal["additive", "literal", "none"] = "none"
    """How e enters the action."""
    probability: Annotated[float, Field(ge=0, le=1)] = 0.0
    """Share ε of the samples that explore."""
    standard_deviation: NonNegatives = ()
    """σ in the units of the actions, (m,)."""


class SensorTable(Table):
    """A sensor: what is measured, how exactly, how often and how late."""

    variable: Name
    """The FMU's variable that it reads: a state, or any output or local variable."""
    deviation: NonNegative = 0.0
    """Standard deviation of its normal noise, in the variable's unit."""
    every: Annotated[int, Field(ge=1)] = 1
    """It takes a reading at each so many-th sample, the first at k = 0."""
    delay: Annotated[int, Field(ge=0, le=1000)] = 0
    """Samples from taking a reading to its arrival."""


class EstimatorTable(Table):
    """The estimator of the state, for controllers that are given what sensors measure."""

    kind: Annotated[str, Field(pattern=r"^(ekf|none|[\w.]+:\w+)$")] = "ekf"
    """`ekf`: an extended Kalman filter on the controller's model. `none`: the controller gets the
    readings as they are. `module:factory`: a factory(scenario) of an estimator."""
    disturbance_deviation: NonNegatives | None = None
    """Standard deviation that the filter expects of each disturbance of the controller's model;
    without it a tenth of the disturbance's magnitude."""
    sensor_deviation: NonNegatives | None = None
    """Standard deviation that the filter expects of each sensor; without it the sensor's own."""
    parameter_drift: NonNegative = 0.1
    """Deviation that the filter expects of the daily change of each uncertain parameter of the
    controller's model, as a share of its nominal value; 0 takes the parameters as they are."""


class LogColumnsTable(Table):
    """A log of the plant, from which a controller learns (`cosim train --data`)."""

    columns: dict[str, Name]
    """The file's name of a column by ours: of a state, of a sensor (`measured[X2]`), of an action,
    of `time` or `stage_cost`. A column that is left out has our name."""


class SignalTable(Table):
    """A signal: what moves with time, what it moves, and what a controller knows of it.

    Each value holds until the next one; the last one until the end of `period` or `once`. A sample
    has the value at its begin, from its first to its last second. A signal
    that `measures` a disturbance has none: its values are what the plant realises.
    """

    name: Name
    """Its name in messages and records, and to controllers."""
    values: Numbers = ()
    """Its values. A `file` takes their place, a CSV with a column of the signal's name and, if the
    values are not evenly spread, a column `time`."""
    times: NonNegatives | None = None
    """Times in s at which the values begin, from 0 on; without it they are evenly spread."""
    period: Positive | None = None
    """Seconds after which the values begin again."""
    once: Positive | None = None
    """Seconds that the values last; a longer run is refused."""
    measures: Name | None = None
    """In place of values: the disturbance of the plant that is measured, and forecast."""
    error: NonNegative = 0.0
    """Standard deviation of a forecast's error a sample ahead; j samples ahead √j times that."""
    plant: Name | None = None
    """The FMU's input or tunable parameter that it drives, from the begin of each sample."""
    price_of: Name | None = None
    """The FMU's output that it is the price of, in the cost of a sample."""
    included: Number = 0.0
    """The price of that output which the FMU's own stage cost has in it."""
    model: Name | None = None
    """The disturbance or parameter that it is in the controller's model."""
    bound: Annotated[str, Field(pattern=r"^x_[lu]\[.+\]$")] | None = None
    """The state bound that it is, `x_l[X2]` or `x_u[X2]`, to the penalty too."""
    reference: Name | None = None
    """The state or action whose reference it is."""
    known: Literal["none", "now", "preview"] = "none"
    """Knowledge of the controller: nothing, the present value, or the coming ones too."""
    ahead: Annotated[int, Field(ge=1, le=1000)] | None = None
    """Samples that a preview reaches beyond the present one; without it the horizon."""

    @model_validator(mode="before")
    @classmethod
    def _read_file(cls, document: Any) -> Any:
        """The document with what its `file` holds in the place of it, so that the hash has it."""
        if not isinstance(document, Mapping) or "file" not in document:
            return document
        content = dict(document)
        file = content.pop("file")
        if "values" in content or "times" in content:
            raise ValueError("signal: give either file, or values and times")
        return content | read_signal_file(str(file), str(content.get("name", "")))

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        where = f"signal '{self.name}'"
        if self.measures is not None:
            self._check_measurement(where)
            return self
        if not self.values:
            raise ValueError(f"{where}: give values or a file, or what it measures")
        if (self.period is None) == (self.once is None):
            raise ValueError(
                f"{where}: give period, the seconds after which its values begin again, or once, "
                "the seconds that they last"
            )
        if self.times is not None:
            self._check_times(self.times, where)
        self._check_roles(where)
        return self

    def _check_times(self, times: tuple[float, ...], where: str) -> None:
        """Raise ValueError where a value has no time of its own within the signal's length."""
        if len(times) != len(self.values) or times[0] != 0:
            raise ValueError(f"{where}: times must be one for each value, the first 0")
        end = self.length
        for time, next_time in pairwise((*times, end)):
            if time >= next_time:
                raise ValueError(f"{where}: times must increase and end before its {end:g} s")

    def _check_roles(self, where: str) -> None:
        """Raise ValueError where the signal moves nothing, or is several things at once."""
        # What it is to the controller.
        roles = (self.model, self.bound, self.reference)
        n_roles = len(roles) - roles.count(None)
        if n_roles > 1:
            raise ValueError(f"{where}: it can be one of model, bound and reference")
        if not any((self.plant, self.price_of, *roles)):
            raise ValueError(
                f"{where}: it moves nothing; give plant, price_of, model, bound or reference"
            )
        # A controller cannot use a number of which nothing says what it is.
        if self.known != "none" and n_roles == 0:
            raise ValueError(
                f"{where}: known = '{self.known}' needs model, bound or reference: what it is to "
                "the controller"
            )
        if self.ahead is not None and self.known != "preview":
            raise ValueError(f"{where}: ahead needs known = 'preview'")

    def _check_measurement(self, where: str) -> None:
        """Raise ValueError where a measured disturbance is more than that."""
        # Its values are the plant's, and it moves nothing there.
        fields = ("values", "times", "period", "once", "plant", "price_of", "bound", "reference")
        for field in fields:
            if getattr(self, field):
                raise ValueError(f"{where}: it measures a disturbance, so it can have no {field}")
        # Measured for nobody it would only cost the plant a run beforehand.
        if self.model is None or self.known == "none":
            raise ValueError(f"{where}: what it measures needs model, and known: now or preview")

    @property
    def length(self) -> float:
        """Seconds from its first value to its end, or to its begin anew."""
        length = self.period or self.once
        assert length is not None
        return length

    @property
    def bounded_state(self) -> str:
        """Name of the state whose bound it is; empty where it is none."""
        if self.bound is None:
            return ""
        # The field's pattern gives it the form x_l[NAME] or x_u[NAME].
        return self.bound[len("x_l[") : -len("]")]

    @property
    def is_lower_bound(self) -> bool:
        """Whether it is a lower bound."""
        return self.bound is not None and self.bound.startswith("x_l")


class ControllerTable(Table):
    """The controller's model, solver and operating point."""

    model: Annotated[str, Field(pattern=r"^[\w.]+:\w+$")] | None = None
    """Its model of the plant, `module:factory`; not needed by controllers that have none."""
    horizon: Annotated[int, Field(ge=1, le=1000)] = 10
    """Stages N."""
    substeps: Annotated[int, Field(ge=1, le=1000)] = 2
    """Runge–Kutta steps of the model per sample."""
    hessian: Literal["gauss-newton", "exact"] = "gauss-newton"
    """Hessian of the QP: the cost's, or the Lagrangian's, convexified."""
    backend: Annotated[str, Field(pattern=r"^(daqp|proxqp|qpsolvers:\w+)$")] = "daqp"
    """QP solver: `daqp`, `proxqp`, or any of qpsolvers as `qpsolvers:NAME`."""
    iterations: Annotated[int, Field(ge=1, le=100)] = 1
    """QPs a sample: 1 is the real-time iteration, more of them come near to convergence."""
    value_offset: Literal["stage-cost", "discounted"] | None = None
    """c_λ at the start: ℓ_s (paper) or ℓ_s/(1−γ). Without it algorithms choose; else it is ℓ_s."""
    reference_state: Numbers
    """x_s of the operating point, (n,)."""
    reference_action: Numbers
    """u_s, (m,)."""
    reference_cost: Number
    """ℓ_s."""


def _array(field: str) -> cached_property[NDArray[np.float64]]:
    """A field of the document, by its dotted name, as a read-only array."""

    def array(scenario: Scenario) -> NDArray[np.float64]:
        entries = attrgetter(field)(scenario)
        values = np.array(entries, dtype=np.float64)
        # Everybody who asks is given the same array.
        values.flags.writeable = False
        return values

    return cached_property(array)


VIOLATING = 1e-6
"""Violation Σᵢ vᵢ, in the states' units, above which a sample counts as violating.

A controller that holds a state on its bound crosses it by rounding, by 1e-12, at every other
sample: that is no violation to report. Mean violation, penalty and J take violations as they are.
"""


class Penalty:
    """Exact penalty of the state bounds, Σᵢ bᵢ vᵢ + Bᵢ vᵢ² with v = max(x_l − x, x − x_u, 0).

    Source: paper.tex, Simulations (b_σ = 10⁵·1, B_σ = I, at the true bounds).

    Args:
        lower: bounds x_l in the states' units, (n,).
        upper: bounds x_u, (n,).
        linear: weights b, cost per unit, (n,).
        quadratic: weights B, cost per unit², (n,).
    """

    def __init__(
        self,
        lower: ArrayLike,
        upper: ArrayLike,
        linear: ArrayLike,
        quadratic: ArrayLike,
    ) -> None:
        self.lower = np.asarray(lower, dtype=float)
        self.upper = np.asarray(upper, dtype=float)
        self.linear = np.asarray(linear, dtype=float)
        self.quadratic = np.asarray(quadratic, dtype=float)
        # Python's numbers: for a few states they are faster than arrays.
        columns = np.array([self.lower, self.upper, self.linear, self.quadratic])
        rows = columns.T.tolist()
        self._rows = [(i, *row) for i, row in enumerate(rows)]

    def __call__(self, state: Sequence[float] | NDArray[np.float64]) -> float:
        """Penalty of one state (n,), fastest for a list; a NaN state gives NaN."""
        total = 0.0
        for i, lower, upper, linear, quadratic in self._rows:
            x = state[i]
            # The common case first; a NaN goes on and makes the total one.
            if lower <= x <= upper:
                continue
            v = lower - x if x < lower else x - upper
            total += linear * v + quadratic * v * v
        return float(total)

    def along(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Penalty of each of K states (K, n), to the bits of a call."""
        total = np.zeros(len(states))
        violations = self.violation(states)
        # State by state and in this order, as a call adds them up.
        for i, linear in enumerate(self.linear):
            v = violations[:, i]
            total += linear * v + self.quadratic[i] * v * v
        return total

    def violation(self, states: NDArray[np.float64]) -> NDArray[np.float64]:
        """Violation v ≥ 0 of each bound for states (…, n), same shape and units."""
        below = self.lower - states
        above = states - self.upper
        outside: NDArray[np.float64] = np.maximum(below, above)
        return np.maximum(outside, 0.0)


class Scenario(Shown, Table):
    """A benchmark task: plant, sampling, cost, disturbances, bounds and the controller's settings.

    Load one with `Scenario.load`; derive another with `replace`. Times in s, everything else in
    the FMU's units. Raises ScenarioError with one line that names file, field and allowed values.
    """

    schema_version: Annotated[SchemaVersion, Field(alias="schema")]
    """`schema` in the file: 1."""
    name: Name
    """Its name in tables and figures, which does not count in its hash."""
    description: str = ""
    """A line for readers."""
    sampling_time: Positive
    """Sampling time h in s; actions and disturbances are held that long."""
    discount: Annotated[float, Field(gt=0, le=1)]
    """Discount γ of the controller and of learning."""
    plant: PlantTable
    """Table `[plant]`: the true plant, an FMU."""
    disturbance: DisturbanceTable = DisturbanceTable()
    """Table `[disturbance]`: the law by which the FMU draws."""
    bounds: BoundsTable
    """Table `[bounds]`: the true bounds."""
    penalty: PenaltyTable
    """Table `[penalty]`: the price of a violation."""
    exploration: ExplorationTable | None = None
    """Table `[exploration]`: how training explores; without it the algorithm decides."""
    controller: ControllerTable
    """Table `[controller]`: what the controller is told."""
    sensors: Annotated[
        tuple[SensorTable, ...] | None, Field(alias="sensor", min_length=1, strict=False)
    ] = None
    """Tables `[[sensor]]`: what is measured; without any each state, exactly, at each sample."""
    estimator: EstimatorTable | None = None
    """Table `[estimator]`, where there are sensors."""
    signals: Annotated[
        tuple[SignalTable, ...] | None, Field(alias="signal", min_length=1, strict=False)
    ] = None
    """Tables `[[signal]]`: what moves with time."""
    log: LogColumnsTable | None = None
    """Table `[log]`: the columns of a log; it does not count in the hash."""

    @model_validator(mode="after")
    def _sizes_and_signs_fit(self) -> Self:
        self._check_sizes()
        self._check_bounds()
        self._check_times()
        self._check_sensors()
        self._check_signals()
        self._check_log()
        plant = self.plant
        names = (*plant.states, *plant.actions, *plant.disturbances)
        for name in names:
            if names.count(name) > 1:
                raise ValueError(
                    f"plant: names '{name}' twice among states, actions and disturbances"
                )
        # An FMU draws by itself: a law that cannot be written to it would not be in force. One that
        # has no choice of laws has one, which the scenario names; its ranges can be written.
        law = self.disturbance.law
        mapping = plant.mapping
        is_mapped = law in mapping.law_codes if mapping.law else bool(mapping.ranges)
        if law != "none" and not is_mapped:
            raise ValueError(
                f"disturbance.law: '{law}' needs plant.mapping.law and its law_codes, or "
                "plant.mapping.ranges of an FMU that has this law alone"
            )
        constants = self.disturbance.time_constant or ()
        if any(constants) and not mapping.time_constant:
            raise ValueError(
                "disturbance.time_constant: needs plant.mapping.time_constant, a parameter of the "
                "FMU for each disturbance"
            )
        return self

    def _check_sizes(self) -> None:
        """Raise ValueError where a list has not one entry per state, action or disturbance."""
        without_law = self.disturbance.law == "none"
        # Field, what it has an entry for, and whether it may be empty.
        rules = [
            ("plant.initial_state", "state", False),
            ("plant.mapping.initial_state", "state", True),
            ("plant.mapping.nominal", "disturbance", True),
            ("plant.mapping.ranges", "disturbance", True),
            ("plant.mapping.time_constant", "disturbance", True),
            ("disturbance.nominal", "disturbance", without_law),
            ("disturbance.ranges", "disturbance", without_law),
            ("disturbance.time_constant", "disturbance", True),
            ("bounds.state_lower", "state", False),
            ("bounds.state_upper", "state", False),
            ("bounds.action_lower", "action", False),
            ("bounds.action_upper", "action", False),
            ("penalty.linear", "state", False),
            ("penalty.quadratic", "state", False),
            ("controller.reference_state", "state", False),
            ("controller.reference_action", "action", False),
        ]
        if self.exploration is not None and self.exploration.kind != "none":
            rules.append(("exploration.standard_deviation", "action", False))
        sizes = {
            "state": len(self.plant.states),
            "action": len(self.plant.actions),
            "disturbance": len(self.plant.disturbances),
        }
        for field, kind, optional in rules:
            values = attrgetter(field)(self) or ()
            entries = len(values)
            size = sizes[kind]
            if entries == 0 and optional:
                continue
            if entries != size:
                raise ValueError(
                    f"{field}: must have one entry per {kind} (plant.{kind}s has {size}), "
                    f"not {entries}"
                )

    def _check_bounds(self) -> None:
        """Raise ValueError where a lower bound is not below the upper one."""
        for name, (lower, upper) in self.limits.items():
            # Written so that no number is refused, too.
            if not lower < upper:
                kind = "state" if name in self.plant.states else "action"
                raise ValueError(f"bounds.{kind}_lower: must be below {kind}_upper for '{name}'")

    def _check_times(self) -> None:
        """Raise ValueError where steps, start and stop, or the changes do not fit."""
        plant = self.plant
        # Within rounding: 0.3 s in steps of 0.1 s are 2.9999999999999996.
        communication_step = plant.communication_step or self.sampling_time
        steps = self.sampling_time / communication_step
        whole_steps = round(steps)
        if whole_steps < 1 or abs(steps - whole_steps) > 1e-9 * steps:
            raise ValueError("plant.communication_step: must be a divisor of sampling_time")
        start = plant.start_time
        stop = plant.stop_time
        if start is not None and stop is not None and stop <= start:
            raise ValueError("plant.stop_time: must be after plant.start_time")
        times = [change.time for change in plant.changes or ()]
        for time, next_time in pairwise(times):
            if time >= next_time:
                raise ValueError("plant.changes: must have increasing times")

    def _check_log(self) -> None:
        """Raise ValueError where a column is named of what no log has."""
        if self.log is None:
            return
        plant = self.plant
        names = ("time", "stage_cost", *plant.states, *plant.actions, *self.measurement_names)
        for name in self.log.columns:
            if name not in names:
                raise ValueError(
                    f"log.columns: there is no variable '{name}'{instead(name, names)}"
                )

    def _check_sensors(self) -> None:
        """Raise ValueError where two sensors read one variable, or an estimator has none."""
        sensors = self.sensors or ()
        names = [sensor.variable for sensor in sensors]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"sensor: two of them read '{name}'")
        if self.estimator is None:
            return
        if not sensors:
            raise ValueError("estimator: there is no [[sensor]] that it could read")
        expected = self.estimator.sensor_deviation
        if expected is not None and len(expected) != len(sensors):
            raise ValueError(
                f"estimator.sensor_deviation: must have one entry per sensor ({len(sensors)}), "
                f"not {len(expected)}"
            )

    def _check_signals(self) -> None:
        """Raise ValueError where signals do not fit each other or the states and actions."""
        signals = self.signals or ()
        for field in ("name", "plant", "model", "bound", "reference"):
            targets = [getattr(signal, field) for signal in signals]
            for target in targets:
                if target is not None and targets.count(target) > 1:
                    raise ValueError(f"signal: two of them have the {field} '{target}'")
        for signal in signals:
            self._check_signal(signal, f"signal '{signal.name}'")
        self._check_moving_bounds()

    def _check_signal(self, signal: SignalTable, where: str) -> None:
        """Raise ValueError where one signal does not fit the plant."""
        plant = self.plant
        measured = signal.measures
        if measured is not None and measured not in plant.disturbances:
            raise ValueError(
                f"{where}: it measures '{measured}', which is none of plant.disturbances"
                f"{instead(measured, plant.disturbances)}"
            )
        # One variable of the FMU has one writer: the last one would win without a word.
        if signal.plant in plant.actions:
            raise ValueError(f"{where}: plant '{signal.plant}' is an action")
        for change in plant.changes or ():
            if signal.plant in change.parameters:
                raise ValueError(f"{where}: plant '{signal.plant}' is set by plant.changes too")
        self._check_durations(signal, where)
        state = signal.bounded_state
        if state and state not in plant.states:
            raise ValueError(
                f"{where}: bound '{signal.bound}' is of no state{instead(state, plant.states)}"
            )
        names = (*plant.states, *plant.actions)
        if signal.reference is not None and signal.reference not in names:
            raise ValueError(
                f"{where}: reference '{signal.reference}' is no state or action"
                f"{instead(signal.reference, names)}"
            )

    def _check_durations(self, signal: SignalTable, where: str) -> None:
        """Raise ValueError where a value is so short that a sample may pass it over."""
        if signal.measures is not None:
            return
        durations = [signal.length / len(signal.values)]
        if signal.times is not None:
            durations = [end - begin for begin, end in pairwise((*signal.times, signal.length))]
        shortest = min(durations)
        # Times in a file are rounded.
        if shortest < self.sampling_time * (1.0 - 1e-4):
            raise ValueError(
                f"{where}: a value lasts {shortest:g} s, less than the sampling time of "
                f"{self.sampling_time:g} s, and samples would pass it over: give values that last "
                "a sample at least, such as means"
            )

    def _check_moving_bounds(self) -> None:
        """Raise ValueError where a moving bound may come to its counterpart."""
        # Of each state the highest lower bound, and the lowest upper one, of any sample: two
        # signals may have any phase to each other.
        states = self.plant.states
        highest = dict(zip(states, self.bounds.state_lower, strict=True))
        lowest = dict(zip(states, self.bounds.state_upper, strict=True))
        for signal in self.signals or ():
            if signal.is_lower_bound:
                highest[signal.bounded_state] = max(signal.values)
            elif signal.bound is not None:
                lowest[signal.bounded_state] = min(signal.values)
        for name in states:
            lower = highest[name]
            upper = lowest[name]
            # Where nothing moves this has been checked.
            if not lower < upper:
                raise ValueError(
                    f"signal: the lower bound of '{name}' comes up to {lower:g}, and its "
                    f"upper bound down to {upper:g}"
                )

    def _facts(self) -> dict[str, object]:
        plant = self.plant
        disturbances = ", ".join(plant.disturbances)
        return {
            "name": self.name,
            "hash": self.hash,
            "sampling_time": self.sampling_time,
            "fmu": plant.fmu,
            "states": ", ".join(plant.states),
            "actions": ", ".join(plant.actions),
            "disturbances": f"{disturbances} ({self._law()})",
        }

    def _law(self) -> str:
        """The law of the disturbances in words."""
        table = self.disturbance
        if not table.coloured:
            return table.law
        constants = ", ".join(f"{constant:g}" for constant in table.time_constant or ())
        return f"{table.law}, time constants {constants} s"

    @classmethod
    def load(cls, source: str | Path) -> Scenario:
        """Load a preset by name or a TOML file by path; raises ScenarioError.

        `random-SEED` is the evaporator with the random errors of a seed, see `random_plant`;
        `random-coloured-SEED` has time constants, too, see `random_coloured_plant`.
        A document with `extends = NAME_OR_PATH` states only what differs from another one.
        """
        document, origin = read(source)
        return cls.from_dict(document, origin)

    @classmethod
    def from_dict(cls, document: Mapping[str, Any], origin: str = "scenario") -> Scenario:
        """Validate a document.

        Args:
            document: structured like the TOML file.
            origin: what messages call it.

        Raises:
            ScenarioError: in one line that names the field.
        """
        return validated(cls, document, origin, ScenarioError)

    def replace(self, changes: Mapping[str, Any]) -> Scenario:
        """Return the scenario with some fields changed, e.g. `{"plant": {"fmu": "my.fmu"}}`.

        Tables are merged, everything else is replaced; the result is validated as a whole.
        """
        document = merged(self.to_dict(), changes)
        return self.from_dict(document, f"scenario '{self.name}'")

    def at(self, time: float) -> Scenario:
        """The scenario of the plant as it is at a time in s, with no further change to come.

        Only `plant.changes` count; a condenser that fouls goes on fouling.
        """
        document = self.to_dict()
        plant = document["plant"]
        # In the order of their times, so that a later one replaces an earlier one.
        for change in plant.pop("changes", ()):
            if change["time"] <= time:
                plant["parameters"] |= change["parameters"]
        return Scenario.from_dict(document)

    def to_dict(self) -> dict[str, Any]:
        """Return the document that this scenario was validated from, every default written out."""
        document: dict[str, Any] = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        # JSON has no infinity: bounds are taken as they are.
        bounds = {}
        for field, values in self.bounds:
            bounds[field] = list(values)
        document["bounds"] = bounds
        return document

    def to_toml(self) -> str:
        """Return the scenario as TOML text that `load` reads back to an equal scenario."""
        return tomli_w.dumps(self.to_dict())

    @cached_property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of all that bears on results.

        Left out: name, description, the columns of a log, and the folder of a foreign FMU (its file
        name counts). Time constants that are all zero are none.
        """
        document = self.to_dict()
        document.pop("log", None)
        plant = document["plant"]
        del document["name"]
        del document["description"]
        plant["fmu"] = Path(self.plant.fmu).name
        # Scenarios from before there were time constants keep their hash.
        constants = self.disturbance.time_constant or ()
        if not any(constants):
            document["disturbance"].pop("time_constant", None)
            plant["mapping"].pop("time_constant", None)
        # One text for one content, whatever the order of a file's keys.
        canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
        digest = hashlib.sha256(canonical.encode())
        return digest.hexdigest()[:16]

    initial_state = _array("plant.initial_state")
    """State at k = 0, (n,)."""
    state_lower = _array("bounds.state_lower")
    """Lower bounds x_l, (n,)."""
    state_upper = _array("bounds.state_upper")
    """Upper bounds x_u, (n,)."""
    action_lower = _array("bounds.action_lower")
    """Lower bounds u_l, (m,)."""
    action_upper = _array("bounds.action_upper")
    """Upper bounds u_u, (m,)."""
    penalty_linear = _array("penalty.linear")
    """Linear weights b of the violation, (n,)."""
    penalty_quadratic = _array("penalty.quadratic")
    """Quadratic weights B (diagonal) of the violation, (n,)."""
    reference_state = _array("controller.reference_state")
    """Operating point x_s, (n,)."""
    reference_action = _array("controller.reference_action")
    """Operating point u_s, (m,)."""

    @property
    def measurement_names(self) -> tuple[str, ...]:
        """Names of the sensors' signals, `measured[X2]` say; none without sensors."""
        sensors = self.sensors or ()
        return tuple(f"measured[{sensor.variable}]" for sensor in sensors)

    @property
    def estimate_names(self) -> tuple[str, ...]:
        """Names of the estimated states' signals, `estimated[X2]` say; none without sensors."""
        if not self.sensors:
            return ()
        return tuple(f"estimated[{name}]" for name in self.plant.states)

    @property
    def signal_names(self) -> tuple[str, ...]:
        """Names of the valued signals in records, `signal[price]` say; none without any."""
        return tuple(f"signal[{signal.name}]" for signal in self.valued_signals)

    @property
    def valued_signals(self) -> tuple[SignalTable, ...]:
        """The signals that have values, and are no measured disturbance."""
        signals = self.signals or ()
        return tuple(signal for signal in signals if signal.measures is None)

    @property
    def priced(self) -> tuple[str, ...]:
        """Names of the FMU's outputs that signals are the prices of."""
        signals = self.signals or ()
        return tuple(signal.price_of for signal in signals if signal.price_of is not None)

    @cached_property
    def still(self) -> Scenario:
        """The scenario without its signals; itself where it has none."""
        if self.signals is None:
            return self
        # Validated as a whole, as every scenario is.
        document = self.to_dict()
        del document["signal"]
        return Scenario.from_dict(document)

    @cached_property
    def limits(self) -> dict[str, tuple[float, float]]:
        """Lower and upper bound of each state and action by name."""
        bounds = self.bounds
        names = (*self.plant.states, *self.plant.actions)
        lower = (*bounds.state_lower, *bounds.action_lower)
        upper = (*bounds.state_upper, *bounds.action_upper)
        pairs = zip(lower, upper, strict=True)
        return dict(zip(names, pairs, strict=True))

    @cached_property
    def state_penalty(self) -> Penalty:
        """Penalty of a state beyond the bounds."""
        return Penalty(
            self.state_lower,
            self.state_upper,
            self.penalty_linear,
            self.penalty_quadratic,
        )

    @property
    def memory(self) -> float:
        """Longest time constant of the disturbances, in samples; 0 where each draw is new."""
        table = self.disturbance
        if not table.coloured:
            return 0.0
        longest = max(table.time_constant or ())
        return longest / self.sampling_time

    def saturate(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """Actions (…, m) clipped to the actuators' bounds."""
        at_least = np.maximum(action, self.action_lower)
        return np.minimum(at_least, self.action_upper)


PRESETS = Path(__file__).parents[1] / "presets"


def presets() -> list[str]:
    """Names of the scenarios that the package ships."""
    files = PRESETS.glob("*.toml")
    return sorted(file.stem for file in files)


def merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """A document with some fields changed: tables are merged, everything else is replaced.

    Args:
        base: the document.
        changes: what is changed, structured as it.
    """
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        if isinstance(value, Mapping) and isinstance(old, Mapping):
            result[key] = merged(old, value)
        else:
            result[key] = value
    return result


RANDOM = re.compile(r"random-(coloured-)?(0|[1-9]\d{0,8})")
"""Name of the plant that a seed draws: `random-7` say, with time constants `random-coloured-7`."""


RANDOM_PARAMETERS = (
    ("UA2", 6.84, 0.8, 1.3),
    ("C", 4.0, 0.8, 1.3),
    ("F3", 50.0, 0.95, 1.05),
    ("Cp", 0.07, 0.95, 1.05),
    ("lambda_", 38.5, 0.97, 1.03),
    ("lambda_s", 36.6, 0.97, 1.03),
)
"""Parameters of the random evaporator: name, value, and the range of its factor."""


def random_plant(seed: int) -> dict[str, Any]:
    """The changes of `paper` that make a plant with random errors, unknown to its controller.

    Drawn in this order, uniformly unless stated, and rounded to four digits: sampling time 30, 60
    or 120 s; UA2 and C by −20 … +30 %; F3 and Cp by ±5 %, both latent heats by ±3 %; the nominal
    disturbances by ±5 %; the law, uniform or normal; the disturbances' standard deviations by a
    factor of 0.5 … 2, common to all, log-uniform.
    """
    # The order of the draws is part of what a seed means: stored results name these plants.
    rng = np.random.default_rng(seed)
    paper, _ = read("paper")
    sampling_time = float(rng.choice([30.0, 60.0, 120.0]))
    parameters = {}
    for name, value, low, high in RANDOM_PARAMETERS:
        factor = rng.uniform(low, high)
        parameters[name] = _four_digits(value * factor)
    law = paper["disturbance"]
    nominal = []
    for value in law["nominal"]:
        factor = rng.uniform(0.95, 1.05)
        nominal.append(_four_digits(value * factor))
    kind = str(rng.choice(["uniform", "normal"]))
    spread = 2.0 ** rng.uniform(-1.0, 1.0)
    # A uniform law of half width r has the standard deviation r/√3.
    if kind == "normal":
        spread /= math.sqrt(3.0)
    ranges = [_four_digits(value * spread) for value in law["ranges"]]
    return {
        "name": f"random-{seed}",
        "description": f"The evaporator with the random errors that seed {seed} draws; the "
        "controller is not told",
        "sampling_time": sampling_time,
        "plant": {**paper["plant"], "parameters": parameters},
        "disturbance": {"law": kind, "nominal": nominal, "ranges": ranges},
    }


COLOURED_SPREAD = 0.8
"""Standard deviation of a disturbance with a memory, over that of the same plant without.

A filtered uniform draw goes beyond the law's range: so the feed flow does not come near zero.
"""


def random_coloured_plant(seed: int) -> dict[str, Any]:
    """The changes of `paper` that make the plant of `random_plant` with time constants.

    Each disturbance has one with probability 3/4, log-uniform from 1 to 20 minutes, rounded to four
    digits. They are drawn from a stream of their own: all else is that of `random-SEED`. Only
    the standard deviations are 0.8 times as large.
    """
    rng = np.random.default_rng([seed, 1])
    plant = random_plant(seed)
    disturbance = plant["disturbance"]
    time_constants = []
    for _ in disturbance["nominal"]:
        has_memory = rng.uniform() < 0.75
        # Drawn in any case, so that the next one's draw does not hang on this one.
        seconds = 60.0 * 20.0 ** rng.uniform()
        time_constants.append(_four_digits(seconds) if has_memory else 0.0)
    ranges = [_four_digits(COLOURED_SPREAD * value) for value in disturbance["ranges"]]
    changed = {
        "ranges": ranges,
        "time_constant": time_constants,
    }
    return plant | {
        "name": f"random-coloured-{seed}",
        "description": f"The evaporator with the random errors and the time constants of its "
        f"disturbances that seed {seed} draws; the controller is not told",
        "disturbance": disturbance | changed,
    }


def _four_digits(value: float) -> float:
    """A number rounded to four significant digits."""
    return float(f"{value:.4g}")


def read(source: str | Path, seen: tuple[str, ...] = ()) -> tuple[dict[str, Any], str]:
    """Read a preset or file and what it extends.

    Args:
        source: a preset's name, `random-SEED`, `random-coloured-SEED`, or the path of a TOML file.
        seen: files that led here.

    Returns:
        The document, an FMU's path as seen from the file that names it, and what messages call it.

    Raises:
        ScenarioError: there is no such scenario, or it is not readable.
    """
    if not isinstance(source, str | Path):
        raise ScenarioError(
            f"a scenario is a preset's name or a path, not a {type(source).__name__}"
        )
    random = RANDOM.fullmatch(str(source))
    if random is not None:
        coloured, digits = random.groups()
        paper, _ = read("paper")
        draw = random_coloured_plant if coloured else random_plant
        return paper | draw(int(digits)), f"preset '{source}'"
    path = Path(source)
    origin = f"scenario file '{source}'"
    # A preset's name comes before a file of the same name.
    if str(source) in presets():
        path = PRESETS / f"{source}.toml"
        origin = f"preset '{source}'"
    elif path.suffix != ".toml" and len(path.parts) < 2:
        raise ScenarioError(
            f"unknown scenario '{source}'{suggestion(str(source), presets())}; presets are "
            f"{', '.join(presets())}, random-SEED and random-coloured-SEED, or give the path of a "
            "TOML file"
        )
    document = read_toml(path, origin, ScenarioError)
    place = path.resolve()
    folder = place.parent
    # A file's `module:factory` may lie beside it.
    if path.parent != PRESETS:
        import_from(folder)
    whole = resolved(document, origin, folder, (*seen, str(place)))
    return whole, origin


def resolved(
    document: Mapping[str, Any],
    origin: str,
    folder: Path,
    seen: tuple[str, ...] = (),
) -> dict[str, Any]:
    """A document with all that it `extends`, and absolute paths.

    Args:
        document: as it stands in a file.
        origin: what messages call it.
        folder: from which its relative paths are seen.
        seen: files that led here.

    Raises:
        ScenarioError: what it extends is no scenario, or leads back to it.
    """
    # Nothing is validated yet: any value may be of any kind.
    result = copy.deepcopy(dict(document))
    plant = result.get("plant")
    if isinstance(plant, dict):
        fmu = plant.get("fmu")
        if isinstance(fmu, str) and is_file(fmu):
            plant["fmu"] = str(folder / fmu)
    signals = result.get("signal")
    if isinstance(signals, list):
        for signal in signals:
            file = signal.get("file") if isinstance(signal, dict) else None
            if isinstance(file, str):
                signal["file"] = str(folder / file)
    base = result.pop("extends", None)
    if base is None:
        return result
    if not isinstance(base, str):
        raise ScenarioError(f"{origin}: extends must be a preset's name or a path, not {base!r}")
    is_named = base in presets() or RANDOM.fullmatch(base)
    if not is_named:
        base = str(folder / base)
    # The system's calls take no such path.
    if "\0" in base:
        raise ScenarioError(f"{origin}: extends must not hold a null byte")
    place = str(Path(base).resolve())
    if place in seen:
        raise ScenarioError(f"{origin}: extends leads back to itself through '{base}'")
    # Depth first: the base has been resolved as seen from its own folder.
    base_document, _ = read(base, seen)
    return merged(base_document, result)
