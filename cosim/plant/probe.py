"""Abilities of an FMU as a plant, found by trials on instances that are thrown away.

A model description may be silent or wrong about all of it: whether outputs follow the inputs,
whether a reset resets, whether a saved state is the whole state. A plant relies on what was seen.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from itertools import product
from math import ceil, floor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cosim.core.errors import PlantError
from cosim.core.scenario import Scenario
from cosim.plant.fmi import (
    Experiment,
    Instance,
    Order,
    Place,
    Reading,
    UnpackedFmu,
    number,
    unpack,
)
from cosim.plant.wiring import REALS, Wiring, experiment, has_start, interface


class OutputKind(Enum):
    """Kind of an output: the sample to which it belongs, and the evidence."""

    FOLLOWS = "follows the actions at once"
    """Get after Set gives g(x_k, u_k): read before the step."""
    INSTANT = "is of state, time or noise alone"
    """It changes with the step and not with the actions: read before the step."""
    SAMPLE = "is computed by doStep from the sample's begin"
    """After the step it is ℓ(x_k, u_k, d_k), however long the step was: read after the step."""
    END = "is computed by doStep and belongs to the end of the step"
    """After the step it is g(x_{k+1}, u_k); what it is at the sample's begin cannot be had."""
    CONSTANT = "did not change"
    OPEN = "cannot be told"


BEFORE = (OutputKind.FOLLOWS, OutputKind.INSTANT)
AFTER = (OutputKind.SAMPLE, OutputKind.END)


class Restart(Enum):
    """Start of a second episode."""

    RESET = "a reset repeats the first start bit for bit"
    FRESH = "a new instance"
    NEVER = "none"


@dataclass(frozen=True)
class Row:
    """A line of a report: what was asked, what was seen, and what follows for the plant."""

    subject: str
    finding: str
    consequence: str


@dataclass(frozen=True)
class ProbeReport:
    """Findings about an FMU as a plant.

    Attributes:
        fmu, sha256: the file.
        rows: tell it; the other fields are the same for programs.
        outputs: the value of `plant.outputs` that fits; None where the outputs differ.
        kinds: where each output belongs, by name, stage cost first.
        restart: how a second episode begins.
        snapshots, serialises: whether a saved, or serialised, state can be relied on.
        experiment: what the FMU has to be given.
        still: actions that move no state, and whether they move an output.
        undriven: inputs that nobody sets, with their start values.
        starts_anywhere: whether the initial state can be set.
    """

    fmu: Path
    sha256: str
    rows: tuple[Row, ...]
    outputs: str | None
    kinds: dict[str, OutputKind]
    restart: Restart
    snapshots: bool
    serialises: bool
    experiment: Experiment
    still: dict[str, bool]
    undriven: dict[str, str]
    starts_anywhere: bool


@dataclass(frozen=True)
class Subject:
    """An FMU with what a probe needs to drive it.

    Attributes:
        fmu: the file.
        names: of inputs, outputs and states.
        exchanged: their places.
        starts: places and start values.
        start_names: names of the first of these.
        step: communication step in s.
        experiment: what the FMU is given.
        low, high: two values of each input, (m,).
    """

    fmu: UnpackedFmu
    names: tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]
    exchanged: tuple[tuple[Place, ...], tuple[Place, ...], tuple[Place, ...]]
    starts: tuple[tuple[Place, float], ...]
    start_names: tuple[str, ...]
    step: float
    experiment: Experiment
    low: tuple[float, ...]
    high: tuple[float, ...]

    @property
    def key(self) -> tuple[Any, ...]:
        """Subject of a finding."""
        return (
            self.fmu.sha256,
            self.exchanged,
            self.starts,
            self.step,
            self.experiment,
            self.low,
            self.high,
        )


def subject_of(
    scenario: Scenario,
    fmu: UnpackedFmu,
    wiring: Wiring,
) -> Subject:
    """The FMU as a scenario wires it; its actions vary about the reference within the bounds.

    Args:
        scenario: names the variables.
        fmu: the file.
        wiring: the places of the scenario's variables.
    """
    plant = scenario.plant
    step = plant.communication_step or scenario.sampling_time
    steps = round(scenario.sampling_time / step)
    lows = []
    highs = []
    for i, name in enumerate(plant.actions):
        reference = float(scenario.reference_action[i])
        lower = float(scenario.action_lower[i])
        upper = float(scenario.action_upper[i])
        low, high = _two_values(fmu.variable(name), reference, lower, upper)
        lows.append(low)
        highs.append(high)
    outputs = (plant.stage_cost, *plant.disturbances, *scenario.priced)
    exchanged = (
        tuple(wiring.inputs),
        tuple(wiring.outputs),
        tuple(wiring.states),
    )
    return Subject(
        fmu=fmu,
        names=(plant.actions, outputs, plant.states),
        exchanged=exchanged,
        starts=tuple(wiring.starts),
        start_names=tuple(wiring.start_names),
        # As `FmuPlant` steps: a whole number of times in a sample.
        step=scenario.sampling_time / steps,
        experiment=wiring.experiment,
        low=tuple(lows),
        high=tuple(highs),
    )


def _two_values(
    variable: Any,
    value: float,
    lower: float,
    upper: float,
) -> tuple[float, float]:
    """A value within bounds and the variable's own range, and another one."""
    lower = max(lower, number(variable.min, -np.inf))
    upper = min(upper, number(variable.max, np.inf))
    if variable.type not in REALS:
        lower = ceil(lower)
        upper = floor(upper)
        value = min(max(round(value), lower), upper)
        another = upper if value != upper else lower
        return value, float(another)
    value = min(max(value, lower), upper)
    distance = 0.25 * (upper - lower)
    # Upwards, or downwards where that would leave the range.
    other = value + distance
    if other > upper:
        other = value - distance
    return value, other


def bare_subject(
    fmu: UnpackedFmu,
    actions: Sequence[str] = (),
    outputs: Sequence[str] = (),
    states: Sequence[str] = (),
    step: float | None = None,
) -> Subject:
    """The FMU without a scenario.

    Args:
        fmu: the file.
        actions: inputs to act on; without them its real inputs.
        outputs: stage cost and disturbances; without them its real outputs that are no states.
        states: its states; without them those with a derivative, else the outputs.
        step: communication step in s; without it that of the default experiment.

    Raises:
        PlantError: the FMU has no such variable.
    """
    known = fmu.variables
    real_inputs = []
    real_outputs = []
    differentiated = []
    for variable in fmu.description.modelVariables:
        if variable.type not in REALS or variable.shape:
            continue
        if variable.causality == "input":
            real_inputs.append(variable.name)
        if variable.causality == "output":
            real_outputs.append(variable.name)
        # FMI marks the rate, which names the state.
        if getattr(variable, "derivative", None):
            differentiated.append(variable.derivative.name)
    actions = tuple(actions or real_inputs)
    states = tuple(states or dict.fromkeys(differentiated) or real_outputs)
    # A state among the outputs is read as a state, and would be tried twice.
    other_outputs = [name for name in real_outputs if name not in states]
    outputs = tuple(outputs or other_outputs)
    default = fmu.description.defaultExperiment
    stated = step or number(getattr(default, "stepSize", None), 0.0)
    internal = number(fmu.description.coSimulation.fixedInternalStepSize, 0.0)
    lows = []
    highs = []
    for name in actions:
        variable = known[name]
        # Of an array the first element.
        first_start, *_ = str(variable.start or 0).split()
        value = number(first_start, 0.0)
        reach = max(abs(value), 1.0)
        low, high = _two_values(variable, value, value - reach, value + reach)
        lows.append(low)
        highs.append(high)
    exchanged = (
        _places(fmu, actions),
        _places(fmu, outputs),
        _places(fmu, states),
    )
    return Subject(
        fmu=fmu,
        names=(actions, outputs, states),
        exchanged=exchanged,
        starts=(),
        start_names=(),
        step=stated or internal or 1.0,
        experiment=experiment(fmu),
        low=tuple(lows),
        high=tuple(highs),
    )


def _places(fmu: UnpackedFmu, names: Sequence[str]) -> tuple[Place, ...]:
    places = []
    for name in names:
        variable = fmu.variable(name)
        if variable is None:
            raise PlantError(f"FMU '{fmu.path.name}' has no variable '{name}'")
        place = Place(int(variable.valueReference), str(variable.type))
        places.append(place)
    return tuple(places)


class ProbedStep(NamedTuple):
    """Numbers of one step: outputs after the inputs were set (if one looked), states and outputs
    after the step.
    """

    looked: tuple[float, ...]
    states: tuple[float, ...]
    outputs: tuple[float, ...]


class ProbedRun(NamedTuple):
    """States and outputs after the initialisation, and the steps that followed."""

    states: tuple[float, ...]
    outputs: tuple[float, ...]
    samples: tuple[ProbedStep, ...]


class _CannotStartAgainError(PlantError):
    """The one instance that a process may have does not reset."""


class _Bench:
    """Instances to try, one at a time: a reset one where resets are known to work, else new ones.

    An FMU that can be instantiated only once per process has one in all.

    Attributes:
        instance: the present one; None before the first.
        resets: whether resets are known to work.
        handle: of the state that is saved of it.
    """

    def __init__(self, subject: Subject, experiment: Experiment) -> None:
        self._subject = subject
        self._experiment = experiment
        self.instance: Instance | None = None
        self._is_new = False
        self.resets = False
        self.handle = ctypes.c_void_p()

    def start(self, *, by_reset: bool | None = None) -> Instance:
        """An initialised instance; `by_reset` forces how it is had."""
        reset = self.resets if by_reset is None else by_reset
        if self.instance is None or not (self._is_new or reset):
            self.instantiate()
        assert self.instance is not None
        self.instance.initialise(started=not self._is_new)
        self._is_new = False
        return self.instance

    def instantiate(self) -> None:
        """Make a new instance, in place of the one before."""
        subject = self._subject
        fmu = subject.fmu
        once = fmu.description.coSimulation.canBeInstantiatedOnlyOncePerProcess
        if self.instance is not None and once:
            raise _CannotStartAgainError("it has one instance per process, which does not reset")
        self.close()
        make_instance = interface(fmu)
        self.instance = make_instance(
            fmu,
            subject.exchanged,
            subject.starts,
            subject.step,
            Reading(Order.SET_STEP_GET),
            self._experiment,
            None,
        )
        self._is_new = True

    def close(self) -> None:
        """Free the instance and what was saved of it."""
        if self.instance is not None:
            self.instance.close([self.handle])
            self.instance = None
            self.handle = ctypes.c_void_p()

    def run(
        self,
        inputs: Sequence[tuple[float, ...]],
        *,
        look: bool = False,
        sizes: Sequence[float] = (),
        spacing: float | None = None,
        by_reset: bool | None = None,
    ) -> ProbedRun:
        """Start, and step.

        Args:
            inputs: of each step, (m,).
            look: whether the outputs are also read after each set, which FMI forbids.
            sizes: lengths of the steps in s, where they are not the communication step.
            spacing: seconds between the begins of two steps, where they are another time.
            by_reset: forces how the instance is had.
        """
        fmi = self.start(by_reset=by_reset)
        states = tuple(fmi.states)
        outputs = tuple(fmi.read_outputs())
        samples = self.go_on(fmi, inputs, look=look, sizes=sizes, spacing=spacing)
        return ProbedRun(states, outputs, samples)

    def go_on(
        self,
        fmi: Instance,
        inputs: Sequence[tuple[float, ...]],
        *,
        first: int = 0,
        look: bool = False,
        sizes: Sequence[float] = (),
        spacing: float | None = None,
    ) -> tuple[ProbedStep, ...]:
        """Step an instance.

        Args:
            fmi: it, before sample `first`.
            inputs: of each step, (m,).
            first: number of the first step.
            look: whether the outputs are also read after each set, which FMI forbids.
            sizes: lengths of the steps in s, where they are not the communication step.
            spacing: seconds between the begins of two steps, where they are another time.
        """
        step = spacing or self._subject.step
        lengths = sizes or [step] * len(inputs)
        samples = []
        for k, (values, size) in enumerate(zip(inputs, lengths, strict=True), first):
            fmi.write_inputs(values)
            looked = tuple(fmi.read_outputs()) if look else ()
            # Times are multiples of the step, never sums of it.
            time = self._experiment.start_time + k * step
            states = tuple(fmi.take_step(time, size))
            outputs = tuple(fmi.read_outputs())
            samples.append(ProbedStep(looked, states, outputs))
        return tuple(samples)


def _same(one: ProbedRun | Sequence[ProbedStep], other: ProbedRun | Sequence[ProbedStep]) -> bool:
    """Whether two runs, or parts of them, have the same numbers; what was looked at is left out."""
    # To the bit; an output that is no number yet is so in both.
    return np.array_equal(_all_numbers(one), _all_numbers(other), equal_nan=True)


def _all_numbers(part: ProbedRun | Sequence[ProbedStep]) -> list[float]:
    if isinstance(part, ProbedRun):
        return [*part.states, *part.outputs, *_all_numbers(part.samples)]
    values: list[float] = []
    for sample in part:
        values += [*sample.states, *sample.outputs]
    return values


GENTLE = 0.02
"""Share of the distance by which inputs vary where an FMU failed under the whole of it."""
SHORT_STEP = 2.0**-14
"""A short step, as a share of a step: what is continuous has hardly moved."""
SAVED_STEPS = 4
"""Steps of a run in which a state is saved after the first one and set again after the last."""
HARDLY = 0.05
"""Largest move of an output in a short step, as a share of its move in a step."""


def as_asked(asked: float, value: float) -> bool:
    """Whether an FMU has the number that it was given, within rounding of a float of 32 bits.

    Args:
        asked: what it was given.
        value: what it has.
    """
    scale = max(abs(asked), abs(value))
    return abs(asked - value) <= 1e-6 * scale


class Point(NamedTuple):
    """What follows from sample `k` on: the numbers before the step, after it, after half of it, and
    after short ones under either input.
    """

    k: int
    before: ProbedStep
    after: ProbedStep
    half: ProbedStep
    short: tuple[ProbedStep, ...]

    def moves(self) -> bool:
        """Whether half a step ends in another state than a whole one."""
        return self.after.states != self.half.states

    def is_continuous(self, i: int) -> bool | None:
        """Whether output i is hardly moved by a short step, whatever the input.

        An output that the step computes from the input is: it jumps, for one input at least. None
        where nothing moves: neither the output in a step, nor anything in a short one.
        """
        before = self.before.outputs[i]
        after = self.after.outputs[i]
        reach = HARDLY * abs(after - before)
        anything_moves = False
        jumps = False
        for sample in self.short:
            moved = sample.outputs[i] - before
            if sample.states != self.before.states or moved != 0:
                anything_moves = True
            # Written so that no number is a jump, too.
            if not abs(moved) <= reach:
                jumps = True
        if not anything_moves:
            return None if after == before else False
        return not jumps


def _kind_of(
    i: int,
    points: Sequence[Point],
    acts: bool,
    starts_alike: bool,
) -> OutputKind:
    """Sample to which output i belongs, if it changes and does not follow a set.

    `acts` says that it depends on the action of the same step, `starts_alike` that its value after
    the initialisation repeats.
    """
    if any(point.after.outputs[i] != point.half.outputs[i] for point in points):
        # It depends on how long the step was: it belongs to the end, or is continuous in time.
        continuous = {point.is_continuous(i) for point in points} - {None}
        if continuous == {True} and starts_alike:
            return OutputKind.INSTANT
        return OutputKind.END
    for point in points:
        # The step moved the state, and the output is another one after it, or by the action.
        changed = point.after.outputs[i] != point.before.outputs[i]
        if point.moves() and (changed or (acts and point.k == 0)):
            return OutputKind.SAMPLE
    return OutputKind.OPEN


class Findings(NamedTuple):
    """Findings of `Probe` before a plant runs.

    Attributes:
        experiment: what the FMU has to be given.
        restart: how a second episode begins.
        kinds: where each output belongs, (1+p,).
        harmless: whether a get after a set leaves what follows as it is; None: not known.
        misset: start values that the FMU has not as asked: name, value asked for, value had.
        keeps_to_step: false where a step goes equally far however long it is asked to be.
        failure: what the FMU said if it failed meanwhile, else empty.
    """

    experiment: Experiment
    restart: Restart
    kinds: tuple[OutputKind, ...]
    harmless: bool | None
    misset: tuple[tuple[str, float, float], ...]
    keeps_to_step: bool
    failure: str


class Probe:
    """Findings about a subject; each property is tried once and kept.

    Raises PlantError where the FMU cannot be instantiated at all. An FMU that fails while it is
    tried leaves a question open.
    """

    def __init__(self, subject: Subject) -> None:
        self.subject = subject
        self._open = (OutputKind.OPEN,) * len(subject.names[1])
        self._first: ProbedRun | None = None
        # States and steps behind the saved state, once it is proven.
        self._after_saving: tuple[tuple[float, ...], tuple[ProbedStep, ...]] = ((), ())
        self._vary_inputs(1.0)

    def _vary_inputs(self, share: float) -> None:
        """Choose the inputs of the runs; real ones vary by a share of their distance."""
        low = self.subject.low
        high = list(self.subject.high)
        inputs, _, _ = self.subject.exchanged
        for i, place in enumerate(inputs):
            # An integer has nothing between two values.
            if place.type not in REALS:
                continue
            distance = high[i] - low[i]
            high[i] = low[i] + share * distance
        self._low = low
        self._high = tuple(high)
        # Changes at most steps, and one input twice: an output that follows changes with it.
        self._inputs = (self._high, low, self._high, low, low, self._high)
        # Another first input.
        self._other_inputs = (low,) * len(self._inputs)
        # Another third input.
        self._late_inputs = (self._high, low, low)

    @cached_property
    def findings(self) -> Findings:
        """When outputs are read, how an episode begins, what the FMU is told."""
        asked = self.subject.experiment
        attempts = [asked]
        # Some FMUs do not run without a stop time.
        default = self.subject.fmu.description.defaultExperiment
        stop_time = number(getattr(default, "stopTime", None), np.inf)
        if asked.stop_time is None and np.isfinite(stop_time):
            attempts.append(asked._replace(stop_time=stop_time))
        failures = []
        # An FMU may not bear what a controller would not do; nearer to the reference it may.
        for share, attempt in product((1.0, GENTLE), attempts):
            self._vary_inputs(share)
            bench = _Bench(self.subject, attempt)
            try:
                bench.instantiate()
                try:
                    first = bench.run(self._inputs)
                except PlantError as error:
                    failures.append(str(error))
                    continue
                self._first = first
                return self._examine(bench, first, attempt)
            finally:
                bench.close()
        # It fails at once: the plant will say so when it is used.
        return self._nothing_known(asked)._replace(failure=failures[0])

    def _nothing_known(self, experiment: Experiment) -> Findings:
        return Findings(
            experiment=experiment,
            restart=Restart.FRESH,
            kinds=self._open,
            harmless=None,
            misset=(),
            keeps_to_step=True,
            failure="",
        )

    def _examine(
        self,
        bench: _Bench,
        first: ProbedRun,
        experiment: Experiment,
    ) -> Findings:
        """Findings of the runs after a first one; the first failure ends it."""
        seen = self._nothing_known(experiment)
        looked: Sequence[ProbedStep] | None = None
        # A reset must repeat the first run to the bit, before any other run relies on it.
        try:
            after_reset = bench.run(self._inputs, look=True, by_reset=True)
            bench.resets = _same(after_reset, first)
            # Both is shown at once: each step of a plant may take a second.
            if bench.resets:
                looked = after_reset.samples
        except PlantError as error:
            seen = seen._replace(failure=str(error))
        # The reset or the look is at fault.
        if not bench.resets:
            try:
                after_reset = bench.run(self._inputs, by_reset=True)
                bench.resets = _same(after_reset, first)
                seen = seen._replace(failure="")
            except PlantError as error:
                seen = seen._replace(failure=str(error))
        # Each finding is kept as it is made: a later run may fail.
        try:
            if bench.resets:
                seen = seen._replace(restart=Restart.RESET)
                starts_alike = True
            else:
                second = bench.run(self._inputs, by_reset=False)
                starts_alike = second.outputs == first.outputs
                # Noise that no seed holds: runs that differ in one thing say nothing.
                if not _same(second.samples, first.samples):
                    line = "two new instances under the same actions give different numbers"
                    return seen._replace(failure=seen.failure or line)
            # FMI forbids it: an FMU may answer, and go on otherwise than it would have.
            if looked is None:
                looked = bench.run(self._inputs, look=True).samples
            harmless = _same(looked, first.samples)
            seen = seen._replace(harmless=harmless)
            # A look that changes what follows says nothing of the FMU without it.
            usable = looked if harmless else ()
            kinds = self._kinds(bench, first, usable, starts_alike)
            misset = self._misset(bench)
            seen = seen._replace(kinds=kinds, misset=misset)
            keeps_to_step = self._keeps_to_step(bench, first)
            return seen._replace(keeps_to_step=keeps_to_step)
        except _CannotStartAgainError as error:
            return seen._replace(restart=Restart.NEVER, failure=str(error))
        except PlantError as error:
            return seen._replace(failure=str(error))

    def _keeps_to_step(self, bench: _Bench, first: ProbedRun) -> bool:
        """Whether half a step ends elsewhere than a whole one, or two halves where it does.

        A sampled plant, which moves at the begin of a sample and rests till the next, does the
        latter; one that goes by a step of its own, whatever it is told, neither.
        """
        half = self.subject.step / 2
        same_twice = self._inputs[:1] * 2
        # An FMU that refuses half a step knows how long a step is.
        try:
            run = bench.run(same_twice, sizes=[half, half], spacing=half)
        except PlantError:
            # A call that failed leaves an instance of which nothing is known.
            bench.instantiate()
            return True
        after_whole = first.samples[0].states
        after_half, after_two_halves = (sample.states for sample in run.samples)
        return after_half != after_whole or after_two_halves == after_whole

    def _misset(self, bench: _Bench) -> tuple[tuple[str, float, float], ...]:
        """Start values that the FMU did not take: name, what was asked for, what it has."""
        fmi = bench.start()
        present = fmi.read_starts()
        subject = self.subject
        rows = []
        # The seed's words, which stand behind the named starts, are no values that one reads back.
        for i, name in enumerate(subject.start_names):
            _, asked = subject.starts[i]
            value = present[i]
            if not as_asked(asked, value):
                rows.append((name, asked, value))
        return tuple(rows)

    def _kinds(
        self,
        bench: _Bench,
        first: ProbedRun,
        looked: Sequence[ProbedStep],
        starts_alike: bool,
    ) -> tuple[OutputKind, ...]:
        """Sample to which each output belongs, by runs that differ in one thing.

        `looked` are the samples of `first` with a look after each set, if that is harmless.
        """
        _, output_places, state_places = self.subject.exchanged
        n_outputs = len(output_places)
        other = bench.run(self._other_inputs[:1], look=bool(looked))
        follows = [False] * n_outputs
        if looked:
            late = bench.run(self._late_inputs, look=True)
            for i in range(n_outputs):
                # It follows where it does so at the first sample and at a later one.
                at_first = looked[0].looked[i] != other.samples[0].looked[i]
                at_third = looked[2].looked[i] != late.samples[2].looked[i]
                follows[i] = at_first and at_third
        known_points: list[Point] | None = None
        kinds = []
        for i, place in enumerate(output_places):
            acts = first.samples[0].outputs[i] != other.samples[0].outputs[i]
            values = {sample.outputs[i] for sample in first.samples}
            changes = values != {first.outputs[i]}
            # A state needs no proof.
            if place in state_places:
                kinds.append(OutputKind.INSTANT)
            elif follows[i]:
                kinds.append(OutputKind.FOLLOWS)
            elif not (acts or changes):
                kinds.append(OutputKind.CONSTANT)
            else:
                # A dozen steps, which other outputs do not need.
                if known_points is None:
                    known_points = self._points(bench, first)
                kinds.append(_kind_of(i, known_points, acts, starts_alike))
        return tuple(kinds)

    def _points(self, bench: _Bench, first: ProbedRun) -> list[Point]:
        """Points of the run from which steps of other lengths were taken."""
        points = [self._point(bench, first, 0)]
        # At the first sample an output may be what the initialisation left.
        if self.subject.fmu.description.coSimulation.canHandleVariableCommunicationStepSize:
            points.append(self._point(bench, first, 2))
        return [point for point in points if point is not None]

    def _point(
        self,
        bench: _Bench,
        first: ProbedRun,
        k: int,
    ) -> Point | None:
        """Steps of other lengths from sample k on; None where the FMU refuses them."""
        step = self.subject.step
        # Before the first sample there is what the initialisation left.
        before = ProbedStep((), first.states, first.outputs)
        if k > 0:
            before = first.samples[k - 1]

        def under(values: tuple[float, ...], size: float) -> ProbedStep:
            inputs = (*self._inputs[:k], values)
            sizes = [step] * k + [size]
            run = bench.run(inputs, sizes=sizes)
            return run.samples[k]

        try:
            half = under(self._inputs[k], step / 2)
            at_low = under(self._low, step * SHORT_STEP)
            at_high = under(self._high, step * SHORT_STEP)
        except PlantError:
            bench.instantiate()
            return None
        return Point(k, before, first.samples[k], half, (at_low, at_high))

    @cached_property
    def reading(self) -> Reading:
        """The order of a step's calls that gives each output where it belongs."""
        kinds = self.findings.kinds
        # What follows the actions needs a get between set and step, what is of state or time one
        # before both; the late ones are read once more after the step.
        if OutputKind.FOLLOWS in kinds:
            order = Order.SET_GET_STEP
        elif OutputKind.INSTANT in kinds:
            order = Order.GET_SET_STEP
        else:
            return Reading(Order.SET_STEP_GET)
        late = []
        for i, kind in enumerate(kinds):
            if kind in AFTER or kind is OutputKind.OPEN:
                late.append(i)
        return Reading(order, tuple(late))

    @property
    def outputs(self) -> str | None:
        """The value of `plant.outputs` that fits, None where the outputs differ."""
        reading = self.reading
        if reading.late:
            return None
        if reading.order is Order.SET_STEP_GET:
            return "after-step"
        return "before-step"

    def stated(self, outputs: str) -> Reading:
        """The reading for a value of `plant.outputs`; raises PlantError where it was seen wrong."""
        kinds = self.findings.kinds
        wrong = AFTER if outputs == "before-step" else BEFORE
        fault = ""
        for name, kind in zip(self.subject.names[1], kinds, strict=True):
            if kind in wrong:
                fault = f"output '{name}' {kind.value}"
                break
        if not fault and outputs == "before-step" and self.findings.harmless is False:
            fault = "a get after a set changes what follows"
        if fault:
            cure = "leave it out"
            if self.outputs:
                cure = f'set it to "{self.outputs}"'
            raise PlantError(
                f'plant.outputs = "{outputs}" does not fit FMU '
                f"'{self.subject.fmu.path.name}': {fault}; {cure}"
            )
        if outputs == "after-step":
            return Reading(Order.SET_STEP_GET)
        # Outputs that no action moves at once need no set before them, which FMI forbids.
        if OutputKind.INSTANT in kinds and OutputKind.FOLLOWS not in kinds:
            return Reading(Order.GET_SET_STEP)
        return Reading(Order.SET_GET_STEP)

    @property
    def misfit(self) -> str:
        """Why the FMU cannot be the plant as asked; empty if it can."""
        findings = self.findings
        name = f"FMU '{self.subject.fmu.path.name}'"
        # The first of them: others may follow from it.
        for start, asked, value in findings.misset:
            return (
                f"{name} was given {start} = {asked:g} and has {value:g} after its initialisation"
            )
        if findings.keeps_to_step:
            return ""
        # Its own step is known by its default experiment alone.
        default = self.subject.fmu.description.defaultExperiment
        fixed = float(getattr(default, "stepSize", None) or 0.0)
        step = self.subject.step
        if fixed and abs(step - fixed) > 1e-9 * fixed:
            return (
                f"{name} goes equally far however long a step is told to be, and its own step is "
                f"{fixed:g} s by its default experiment, not {step:g} s: set sampling_time or "
                "plant.communication_step to it"
            )
        return ""

    @property
    def cost_of_sample(self) -> bool:
        """Whether the stage cost is that of the sample's begin, ℓ(x_k, u_k, d_k), or may be."""
        return self.findings.kinds[0] is not OutputKind.END

    @property
    def snapshots(self) -> str:
        """Why a saved state cannot be relied on; empty if it can."""
        return self._faults_of_saving[0]

    @property
    def serialises(self) -> str:
        """Why a serialised state cannot be relied on; empty if it can."""
        return self._faults_of_saving[1]

    @cached_property
    def _faults_of_saving(self) -> tuple[str, str]:
        """Why a saved state cannot be relied on, and why a serialised one; empty if it can."""
        bench = _Bench(self.subject, self.findings.experiment)
        try:
            bench.instantiate()
            fault = self._try_snapshot(bench)
        except PlantError as error:
            fault = str(error)
        try:
            # The same saved state: it was proven, and a step may take a second.
            return fault, fault or self._try_serialised(bench)
        except PlantError as error:
            return fault, str(error)
        finally:
            bench.close()

    def _go_on_from_saved(self, bench: _Bench) -> tuple[ProbedStep, ...]:
        """The steps after the first one, behind which the state is saved."""
        assert bench.instance is not None
        return bench.go_on(bench.instance, self._inputs[1:SAVED_STEPS], first=1)

    def _try_snapshot(self, bench: _Bench) -> str:
        # What the same steps give where nothing is saved: the first run of all, if there was one.
        without = self._first or bench.run(self._inputs)
        fmi = bench.start()
        fmi.require_state()
        # From here on it may be taken back.
        fmi.no_return.value = False
        bench.go_on(fmi, self._inputs[:1])
        states = tuple(fmi.states)
        fmi.save(bench.handle)
        samples = self._go_on_from_saved(bench)
        if not _same(samples, without.samples[1:SAVED_STEPS]):
            return "while a state is saved the same steps give other numbers"
        fmi.load(bench.handle)
        if tuple(fmi.states) != states:
            return "a state that was saved and set again is another one"
        # What the FMU hides, its noise say, has to be in the saved state as well.
        again = self._go_on_from_saved(bench)
        if not _same(again, samples):
            return "after a state was saved and set again the same steps give other numbers"
        self._after_saving = states, samples
        return ""

    def _try_serialised(self, bench: _Bench) -> str:
        fmi = bench.instance
        assert fmi is not None
        states, samples = self._after_saving
        data = fmi.serialise(bench.handle)
        fmi.deserialise(data, bench.handle)
        fmi.load(bench.handle)
        is_there = tuple(fmi.states) == states
        if not is_there or not _same(self._go_on_from_saved(bench), samples):
            return "after a state was serialised and set again the same steps give other numbers"
        return ""

    @cached_property
    def still(self) -> dict[str, bool]:
        """The actions that move no state by themselves, and whether they move an output."""
        bench = _Bench(self.subject, self.findings.experiment)
        try:
            bench.instantiate()
            # All actions low, then one of them high.
            rest = bench.run(self._other_inputs).samples
            states_at_rest = [sample.states for sample in rest]
            action_names, _, _ = self.subject.names
            names = {}
            for i, name in enumerate(action_names):
                moved = list(self._low)
                moved[i] = self._high[i]
                inputs = [tuple(moved)] * len(rest)
                samples = bench.run(inputs).samples
                states = [sample.states for sample in samples]
                if states == states_at_rest:
                    names[name] = not _same(samples, rest)
            return names
        except PlantError:
            return {}
        finally:
            bench.close()


_probes: dict[tuple[Any, ...], Probe] = {}
"""Probes of this process by what their findings hold for."""


def probe_of(subject: Subject) -> Probe:
    """The one probe of a subject in this process."""
    # To try an FMU takes a dozen short runs; a study makes hundreds of plants of it.
    key = subject.key
    if key not in _probes:
        _probes[key] = Probe(subject)
    return _probes[key]


def probe(
    plant: Scenario | str | Path,
    *,
    actions: Sequence[str] = (),
    outputs: Sequence[str] = (),
    states: Sequence[str] = (),
    step: float | None = None,
) -> ProbeReport:
    """Find out whether an FMU can be a plant, and how.

    Args:
        plant: A scenario, or an FMU: the path of one or the name of a shipped one.
        actions: Of an FMU, the inputs to act on; without them its real inputs.
        outputs: Of an FMU, the stage cost and disturbances; without them its real outputs.
        states: Of an FMU, its states; without them those with a derivative, else the outputs.
        step: Of an FMU, the communication step in s; without it that of its default experiment.

    Returns:
        What was tried, what was seen, and what follows.

    Raises:
        PlantError: The FMU cannot be loaded or instantiated, or lacks a variable.
    """
    if isinstance(plant, Scenario):
        fmu = unpack(plant.plant.fmu)
        subject = subject_of(plant, fmu, Wiring(plant, fmu))
        starts_anywhere = bool(plant.plant.mapping.initial_state)
    else:
        fmu = unpack(plant)
        subject = bare_subject(fmu, actions, outputs, states, step)
        # By name alone: `start_parameters` proves it, and needs a scenario.
        starts_anywhere = True
        for name in subject.names[2]:
            has_parameter = f"{name}_start" in fmu.variables
            if not has_parameter and not has_start(fmu.variable(name)):
                starts_anywhere = False
    return _as_report(probe_of(subject), starts_anywhere)


def _undriven_inputs(subject: Subject) -> dict[str, str]:
    """Start values of the inputs that nobody sets, by name."""
    actions, _, _ = subject.names
    started = set()
    for place, _ in subject.starts:
        started.add((place.reference, place.type, place.element))
    undriven = {}
    for variable in subject.fmu.description.modelVariables:
        if variable.causality != "input" or variable.name in actions:
            continue
        first_element = (int(variable.valueReference), str(variable.type), 0)
        # A scenario's parameter drives it, at one value.
        if first_element not in started:
            undriven[variable.name] = str(variable.start or "")
    return undriven


def _as_report(seen: Probe, starts_anywhere: bool) -> ProbeReport:
    subject = seen.subject
    findings = seen.findings
    fmu = subject.fmu
    kinds = dict(zip(subject.names[1], findings.kinds, strict=True))
    undriven = _undriven_inputs(subject)
    rows = [
        _outputs_row(seen, kinds),
        _restart_row(findings),
        _ability_row("snapshot", seen.snapshots, "plants can be saved and restored"),
        _ability_row("serialise", seen.serialises, "checkpoints of a training carry the plant"),
        _experiment_row(findings.experiment, subject.experiment),
        _still_row(seen.still),
        _undriven_row(undriven),
        _start_row(starts_anywhere),
    ]
    if not findings.keeps_to_step:
        rows.append(
            Row(
                "step",
                "goes equally far however long a step is told to be",
                "sampling time or plant.communication_step must be the FMU's own step",
            )
        )
    if findings.failure:
        rows.append(Row("failure", findings.failure, "what it left open is taken as not possible"))
    return ProbeReport(
        fmu=fmu.path,
        sha256=fmu.sha256,
        rows=tuple(rows),
        outputs=seen.outputs,
        kinds=kinds,
        restart=findings.restart,
        snapshots=not seen.snapshots,
        serialises=not seen.serialises,
        experiment=findings.experiment,
        still=seen.still,
        undriven=undriven,
        starts_anywhere=starts_anywhere,
    )


def _outputs_row(seen: Probe, kinds: dict[str, OutputKind]) -> Row:
    said = "; ".join(f"{name} {kind.value}" for name, kind in kinds.items())
    if seen.outputs is None:
        return Row("outputs", said, "each is read where it belongs; leave plant.outputs out")
    order = f'plant.outputs = "{seen.outputs}"'
    is_proven = any(kind in (*BEFORE, *AFTER) for kind in kinds.values())
    if not is_proven:
        order += ", the order that FMI allows, without proof"
    if OutputKind.END in kinds.values():
        order += "; figures that need the cost at the sample's begin are refused"
    return Row("outputs", said, order)


def _restart_row(findings: Findings) -> Row:
    consequence = {
        Restart.RESET: "each episode begins by a reset",
        Restart.FRESH: "each episode is a new instance: a reset was not seen to repeat the start",
        Restart.NEVER: "one episode a process: neither a reset nor a second instance is possible",
    }
    return Row("episodes", findings.restart.value, consequence[findings.restart])


def _still_row(still: dict[str, bool]) -> Row:
    subject = "actions that move no state"
    if not still:
        return Row(subject, "none", "")
    findings = []
    for name, moves_output in still.items():
        what = "outputs only" if moves_output else "nothing"
        findings.append(f"{name} moves {what}")
    consequence = "no controller can act by them so: plant.parameters may set an input that enables"
    return Row(subject, "; ".join(findings), consequence)


def _undriven_row(undriven: dict[str, str]) -> Row:
    subject = "inputs that nobody drives"
    if not undriven:
        return Row(subject, "none", "")
    pairs = [f"{name} = {start or '?'}" for name, start in undriven.items()]
    consequence = "they stay at their start values; plant.parameters may set them"
    return Row(subject, ", ".join(pairs), consequence)


def _start_row(starts_anywhere: bool) -> Row:
    if starts_anywhere:
        return Row("start state", "can be set", "")
    return Row("start state", "cannot be set", "episodes start where the FMU does")


def _ability_row(
    subject: str,
    fault: str,
    use: str,
) -> Row:
    if fault:
        return Row(subject, fault, "not used")
    return Row(subject, "gives the same steps again", use)


def _experiment_row(experiment: Experiment, asked: Experiment) -> Row:
    stop = "none" if experiment.stop_time is None else f"{experiment.stop_time:g} s"
    tolerance = "none" if experiment.tolerance is None else f"{experiment.tolerance:g}"
    finding = f"start {experiment.start_time:g} s, stop {stop}, tolerance {tolerance}"
    consequence = "plant.start_time, plant.stop_time, plant.tolerance set others"
    # Nobody has asked for a stop time: it was found to be needed.
    if experiment.stop_time is not None and asked.stop_time is None:
        consequence = (
            "it does not run without a stop time: no step goes beyond it, plant.stop_time sets "
            "another"
        )
    return Row("experiment", finding, consequence)
