"""The optimal policy of a scenario's stochastic plant: the benchmark's yardstick."""

from __future__ import annotations

import ctypes
import hashlib
import io
import itertools
import json
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from math import isfinite, modf
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.dynamic_programming import (
    Accuracy,
    BellmanOperator,
    GainEstimate,
    Grid,
    Optimum,
    RoundProgress,
    Settings,
    solve,
)
from controllers.dynamic_programming.periodic import PeriodicOptimum
from controllers.errors import OptimumError, QpError
from controllers.export.core import ENGINE_SOURCES
from controllers.functions import COMPILED, INTERPRETED, LONG, library, worth_compiling
from controllers.model import Model
from controllers.problem import VECTORS, PlantProblem, Problem, load_model
from cosim.core.files import cache_folder, read_arrays, write_atomically
from cosim.core.protocols import ActionLimits, Array, CompiledLoop, Decision, Vector
from cosim.core.scenario import ChangeTable, Penalty, Scenario

AnyOptimum = TypeVar("AnyOptimum", Optimum, PeriodicOptimum)

SOLVER_VERSION = 2
"""Part of every key; to be raised when the solver's results change."""
SHIPPED_OPTIMA = Path(__file__).parent / "optima"
SECONDS_A_DAY = 86400.0
FOULING_NODES = 6
"""Values of the fouled parameter whose optima make the quasi-static reference."""
FOULING_PARAMETERS = ("fouling_rate", "fouling_floor", "cleaning_period")
"""The plant's parameters of the law of fouling; the model has none of them."""


# solved problems as files ---------------------------------------------------------------------


def optimum_key(plant: PlantProblem, settings: Settings) -> str:
    """First 16 hexadecimal digits of the SHA-256 of all that the solution depends on.

    Args:
        plant: The plant's model with its law and parameters.
        settings: The solver's settings.
    """
    problem = plant.problem
    model = problem.model
    law = plant.law
    # Of the model's functions what they compute, not how they are written.
    symbols = model.symbols()
    rates = model.ode(*symbols)
    cost = model.economic_cost(*symbols)
    law_facts = [law.kind, law.nominal.tolist(), law.ranges.tolist()]
    settings_facts = asdict(settings) | {"criterion": "average"}
    content: dict[str, Any] = {
        "version": SOLVER_VERSION,
        "ode": _operations(rates, symbols),
        "cost": _operations(cost, symbols),
        "time_unit": model.time_unit,
        "sampling_time": problem.sampling_time,
        # The mean cost per sample has no discount, whatever the controller's is.
        "discount": 1.0,
        "parameters": plant.parameters.tolist(),
        "law": law_facts,
        "settings": settings_facts,
    }
    for name in VECTORS:
        content[name] = getattr(problem, name).tolist()
    if plant.memory is not None:
        content["memory"] = asdict(plant.memory)
    text = json.dumps(content, sort_keys=True)
    digest = hashlib.sha256(text.encode())
    return digest.hexdigest()[:16]


def _operations(expression: ca.SX, symbols: tuple[ca.SX, ...]) -> list[str]:
    """An expression's elementary operations, one a line."""
    function = ca.Function("e", list(symbols), [expression])
    lines = []
    # Instructions and not the text of the expression: its names and its layout decide nothing.
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        inputs = function.instruction_input(k)
        outputs = function.instruction_output(k)
        constant = ""
        if code == ca.OP_CONST:
            value = float(function.instruction_constant(k))
            # All digits: another constant is another plant.
            constant = value.hex()
        lines.append(f"{code} {inputs} {outputs} {constant}")
    return lines


def stored_file(key: str) -> Path | None:
    """File of a solved problem by its key: the package's own, else the user's, else None."""
    for folder in (SHIPPED_OPTIMA, cache_folder("optima")):
        path = folder / f"{key}.npz"
        if path.is_file():
            return path
    return None


def keep(key: str, optimum: Optimum) -> Path:
    """Keep a solved problem in the user's cache.

    Args:
        key: The problem's `optimum_key`.
        optimum: Its solution.

    Returns:
        The file.
    """
    return write_optimum(cache_folder("optima") / f"{key}.npz", optimum, key)


def write_optimum(
    path: Path,
    optimum: Optimum,
    key: str,
) -> Path:
    """Write a solved problem as a compressed .npz; equal content gives equal bytes.

    Args:
        path: The file.
        optimum: The solution.
        key: The problem's `optimum_key`, which the file holds too.
    """
    document = {**solution_document(optimum, key), "smooth": optimum.grid.smooth}
    arrays = {
        "actions": optimum.actions,
        "W": optimum.W,
        "distribution": optimum.distribution,
    }
    return write_solution(path, optimum.grid, arrays, document)


def solution_document(optimum: Optimum | PeriodicOptimum, key: str) -> dict[str, Any]:
    """Description of a solution of any kind in a file, beside its arrays.

    Args:
        optimum: The solution.
        key: The problem's key, which tells a file that was renamed.
    """
    certificate = [estimate._asdict() for estimate in optimum.certificate]
    return {
        "key": key,
        "gain": optimum.gain,
        "lower": optimum.lower,
        "upper": optimum.upper,
        "accuracy": asdict(optimum.accuracy),
        "certificate": certificate or None,
    }


def write_solution(
    path: Path,
    grid: Grid,
    arrays: Mapping[str, NDArray[Any]],
    document: Mapping[str, Any],
) -> Path:
    """Write a solution as a compressed .npz; equal content gives equal bytes.

    Args:
        path: The file.
        grid: Of the states.
        arrays: By name, beside the grid's axes.
        document: All else, for JSON.

    Returns:
        The file.
    """
    content: dict[str, Any] = {f"axis_{i}": axis for i, axis in enumerate(grid.axes)}
    content.update(arrays)
    content["document"] = np.array(json.dumps(document, sort_keys=True))
    # Through memory, so that the file appears whole or not at all.
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **content)
    return write_atomically(path, buffer.getvalue())


def read_optimum(path: Path, key: str) -> Optimum:
    """Read a solved problem.

    Args:
        path: The file.
        key: The `optimum_key` of the problem that it must hold.

    Raises:
        OptimumError: The file is damaged, or another problem's.
    """
    return read_solution(path, key, _optimum_of)


def read_solution(
    path: Path,
    key: str,
    build: Callable[[Mapping[str, Any], Mapping[str, Any]], AnyOptimum],
) -> AnyOptimum:
    """Read what `write_solution` wrote.

    Args:
        path: The file.
        key: The key that its document must have.
        build: Makes the solution of arrays and document.

    Returns:
        The solution.

    Raises:
        OptimumError: The file is damaged, or another problem's.
    """
    try:
        arrays = read_arrays(path)
        document = json.loads(str(arrays.pop("document")))
        # A file may have been renamed, and then it is another problem's.
        if document["key"] != key:
            raise OptimumError(f"it holds the policy of problem {document['key']}, not of {key}")
        return build(arrays, document)
    except (OSError, KeyError, TypeError, ValueError, AttributeError, OptimumError) as error:
        raise OptimumError(
            f"{path}: not a readable optimal policy ({error}); delete it to have the policy "
            "computed again"
        ) from error


def solution_fields(arrays: Mapping[str, Any], document: Mapping[str, Any]) -> dict[str, Any]:
    """Attributes of a solution from `solution_document` and the grid's axes.

    Args:
        arrays: Of a file.
        document: The file's.
    """
    axis_names = [name for name in arrays if name.startswith("axis_")]
    axes = [arrays[f"axis_{i}"] for i in range(len(axis_names))]
    accuracy = document["accuracy"]
    estimates = document["certificate"] or ()
    certificate = [GainEstimate(**estimate) for estimate in estimates]
    return {
        "grid": Grid(tuple(axes)),
        "gain": float(document["gain"]),
        "lower": float(document["lower"]),
        "upper": float(document["upper"]),
        # JSON has lists for tuples, and may have a whole number for a float.
        "accuracy": Accuracy(
            substeps=int(accuracy["substeps"]),
            nodes=tuple(accuracy["nodes"]),
            penalty_nodes=tuple(accuracy["penalty_nodes"]),
        ),
        "certificate": tuple(certificate),
    }


def _optimum_of(arrays: Mapping[str, Any], document: Mapping[str, Any]) -> Optimum:
    """The optimum in a file's arrays and document."""
    fields = solution_fields(arrays, document)
    smooth = document["smooth"]
    if smooth:
        intervals = []
        for first, last in smooth:
            intervals.append((float(first), float(last)))
        fields["grid"] = Grid(fields["grid"].axes, tuple(intervals))
    return Optimum(
        actions=arrays["actions"],
        W=arrays["W"],
        distribution=arrays["distribution"],
        **fields,
    )


# the optimal policy ---------------------------------------------------------------------------


def look_up(
    table: PolicyTable,
    problem: Problem,
    s: ArrayLike,
) -> tuple[list[float], list[float], str]:
    """A state as numbers, what a table has there, and the status of that answer.

    Args:
        table: of actions and values.
        problem: has the number of states.
        s: State in the model's units, (n,).

    Raises:
        QpError: s is not finite.
    """
    state: list[float] = np.asarray(s, dtype=np.float64).tolist()
    n = problem.n_states
    # A finite sum has finite terms: one test in place of n.
    is_usable = len(state) == n and isfinite(sum(state))
    if not is_usable:
        raise QpError(f"state {state} is not {n} finite numbers", status="bad state")
    # The grid ends where no sample of the closed loop was: say so, and go on.
    row, clamped = table.look_up(state)
    return state, row, "clamped" if clamped else "solved"


class PolicyTable:
    """An action and a value for each state of a grid, interpolated multilinearly.

    Args:
        axes: coordinates of each state, ascending, (≥ 2,) each.
        actions: of the grid's states, the last one running fastest, (K, m).
        values: of the grid's states, (K,).
    """

    def __init__(
        self,
        axes: Sequence[Array],
        actions: Array,
        values: Array,
    ) -> None:
        self.axes = axes
        self.rows = np.column_stack([actions, values])
        # Python's numbers: for a few states they are faster than arrays.
        self._axes = [axis.tolist() for axis in axes]
        self._rows = self.rows.tolist()
        # A cell's corners, and how far each one's row is behind that of the first.
        self._corners = []
        shape = [len(axis) for axis in axes]
        n_states = len(shape)
        for corner in itertools.product((0, 1), repeat=n_states):
            offset = np.ravel_multi_index(corner, shape)
            self._corners.append((corner, int(offset)))

    def look_up(self, state: list[float]) -> tuple[list[float], bool]:
        """Interpolate at a state; in plain Python that takes a tenth of NumPy's time.

        Args:
            state: finite numbers, (n,); one outside the grid is moved to the nearest inside.

        Returns:
            Action and value (m+1,), and whether the state was outside.
        """
        base = 0  # row of the cell's first corner
        clamped = False
        fractions = []
        for x, axis in zip(state, self._axes, strict=True):
            # The last cell includes its upper end.
            last_cell = len(axis) - 2
            cell = bisect_right(axis, x) - 1
            cell = min(max(cell, 0), last_cell)
            begin = axis[cell]
            end = axis[cell + 1]
            fraction = (x - begin) / (end - begin)
            if not 0.0 <= fraction <= 1.0:
                fraction = min(max(fraction, 0.0), 1.0)
                clamped = True
            base = base * len(axis) + cell
            fractions.append(fraction)
        n_entries = len(self._rows[0])
        row = [0.0] * n_entries
        for corner, offset in self._corners:
            weight = 1.0
            for fraction, high in zip(fractions, corner, strict=True):
                # Multilinear: the weight of a corner is the product over the axes.
                weight *= fraction if high else 1.0 - fraction
            if not weight:
                continue
            corner_row = self._rows[base + offset]
            for i, entry in enumerate(corner_row):
                row[i] += weight * entry
        return row, clamped


class _Native(ctypes.Structure):
    """A table for compiled code; the C struct is `PolicyTable` of `optimal.c`."""

    _fields_: ClassVar[list[tuple[str, Any]]] = [
        ("n_states", ctypes.c_size_t),
        ("n_actions", ctypes.c_size_t),
        ("sizes", ctypes.c_void_p),
        ("axes", ctypes.c_void_p),
        ("rows", ctypes.c_void_p),
        ("action_lower", ctypes.c_void_p),
        ("action_upper", ctypes.c_void_p),
        ("state_lower", ctypes.c_void_p),
        ("state_upper", ctypes.c_void_p),
        ("linear", ctypes.c_void_p),
        ("quadratic", ctypes.c_void_p),
        ("action", ctypes.c_void_p),
        ("fractions", ctypes.c_void_p),
        ("row", ctypes.c_void_p),
    ]


def table_sources() -> dict[str, bytes]:
    """C files of the loop of a table and an FMU by name."""
    sources = {}
    for name in ("loop.h", "fmu.h", "optimal.c"):
        sources[name] = (ENGINE_SOURCES / name).read_bytes()
    return sources


class CompiledTable:
    """The closed loop of a table and an FMU in compiled code, with the digits of Python's.

    Args:
        library_path: of the compiled `table_sources`.
        table: the policy.
        penalty: of the states' bounds, which the solution's value has beside the table's.
        limits: bounds of the actuators.
    """

    def __init__(
        self,
        library_path: str,
        table: PolicyTable,
        penalty: Penalty,
        limits: ActionLimits,
    ) -> None:
        self._run = ctypes.CDLL(library_path).optimal_run
        # ctypes takes every result for an int, which is too short for a sample's number.
        self._run.restype = ctypes.c_longlong
        n_states = len(table.axes)
        n_actions = table.rows.shape[1] - 1
        points_of_axes = [len(axis) for axis in table.axes]
        sizes = np.array(points_of_axes, dtype=np.uintp)
        arrays: list[NDArray[Any]] = [sizes]
        # In the order of the struct's pointers.
        numbers = [
            np.concatenate(table.axes),
            table.rows,
            limits.action_lower,
            limits.action_upper,
            penalty.lower,
            penalty.upper,
            penalty.linear,
            penalty.quadratic,
            np.zeros(n_actions),
            np.zeros(n_states),
            np.zeros(n_actions + 1),
        ]
        for array in numbers:
            arrays.append(np.ascontiguousarray(array, dtype=np.float64))
        # Kept: compiled code has only their addresses.
        self._arrays = arrays
        addresses = [array.ctypes.data for array in arrays]
        self._native = _Native(n_states, n_actions, *addresses)

    @classmethod
    def compile(
        cls,
        table: PolicyTable,
        penalty: Penalty,
        limits: ActionLimits,
    ) -> CompiledTable | None:
        """The compiled loop, or None without a compiler.

        Args:
            table: the policy.
            penalty: of the states' bounds.
            limits: bounds of the actuators.
        """
        path = library(table_sources())
        if path is None:
            return None
        return cls(str(path), table, penalty, limits)

    def __call__(
        self,
        plant: Any,
        first: int,
        rows: Array,
    ) -> tuple[int, int, int]:
        """Run samples of the loop (`cosim.core.protocols.CompiledLoop`)."""
        fault = (ctypes.c_int * 2)()
        reached = self._run(
            ctypes.byref(self._native),
            ctypes.byref(plant),
            ctypes.c_longlong(first),
            ctypes.c_longlong(first + len(rows)),
            ctypes.c_void_p(rows.ctypes.data),
            fault,
        )
        return reached, fault[0], fault[1]


class OptimalPolicy:
    """π* and V* = penalty + W of a problem under a disturbance law, from a solved grid.

    V* is the differential value: the cost in excess of J* of a start in s, up to a constant. π* and
    W are interpolated multilinearly; a state outside the grid's box is moved to the nearest inside.
    """

    given = "truth"
    """Input of `feedback`, under sensors too: the optimum sees the state."""

    name = "optimal"

    def __init__(self, plant: PlantProblem, optimum: Optimum) -> None:
        self.problem = plant.problem
        self.optimum = optimum
        self._plant = plant
        axes = optimum.grid.axes
        self._table = PolicyTable(axes, optimum.actions, optimum.W)
        self.functions = INTERPRETED

    @classmethod
    def from_scenario(
        cls,
        scenario: Scenario,
        *,
        progress: RoundProgress | None = None,
    ) -> OptimalPolicy:
        """Optimal policy of a scenario: shipped, cached, or solved now and cached.

        Args:
            scenario: The scenario; the plant is that of `PlantProblem.from_scenario`, whose errors
                are raised.
            progress: Called after each round of the solver.

        Raises:
            OptimumError: A stored file is damaged, or the problem is not solved.
        """
        plant = PlantProblem.from_scenario(scenario)
        if plant.memory is not None:
            model = plant.problem.model
            disturbance = model.disturbances[plant.memory.disturbance]
            raise OptimumError(
                f"the optimal policy needs the value that {disturbance.name} had in the sample "
                "before, which a controller is not told; its J is that of `cosim optimum`"
            )
        key = optimum_key(plant, Settings())
        path = stored_file(key)
        if path is None:
            optimum = solve(plant, progress=progress)
            path = keep(key, optimum)
        # Read back in any case: a policy that was solved now is the one that is stored.
        return cls(plant, read_optimum(path, key))

    @property
    def gain(self) -> float:
        """J*: mean of economic cost and penalty per sample under this policy."""
        return self.optimum.gain

    def compile(self, samples: int = LONG) -> None:
        """Let closed loops of `samples` or more run in compiled code, with the same digits.

        Args:
            samples: of the run; COSIM_COMPILE says `never`, or `now` for any number.
        """
        if worth_compiling(samples):
            self.functions = COMPILED

    def compiled_loop(self, scenario: Scenario) -> CompiledLoop | None:
        """A new closed loop in compiled code; None if only Python can run it.

        Args:
            scenario: of the plant; its actions are saturated as it says.
        """
        if self.functions == INTERPRETED:
            return None
        # A plant may have more states than the model, which the loop in C does not pick.
        n_states = len(scenario.plant.states)
        if n_states != self.problem.n_states:
            return None
        loop = CompiledTable.compile(self._table, self.problem.penalty, scenario)
        if loop is None:
            self.functions = INTERPRETED
        return loop

    def reset(self) -> None:
        """Do nothing: the policy has no memory."""

    def prepare(self) -> None:
        """Do nothing."""

    def feedback(self, s: ArrayLike, a: ArrayLike | None = None) -> Decision:
        """π*(s) and V*(s), or Q*(s, a) where `a` is given; `clamped` outside the grid.

        Args:
            s: State in the model's units, (n,).
            a: Action to enforce, (m,).

        Raises:
            QpError: s or a is not finite.
        """
        state, row, status = look_up(self._table, self.problem, s)
        if a is None:
            W = row.pop()
            action = np.array(row)
            value = W + self.problem.penalty(state)
        else:
            action = np.array(a, dtype=np.float64)
            value = self.action_value(state, action)
        return Decision(action, value, status, 0.0)

    def action_value(self, s: ArrayLike, a: ArrayLike) -> float:
        """Q*(s, a) = penalty(s) + E[ℓ − J* + V*(s₊)].

        Args:
            s: State in the model's units, (n,).
            a: Action, (m,).

        Raises:
            QpError: a is not finite.
        """
        problem = self.problem
        optimum = self.optimum
        m = problem.n_actions
        # The operator takes many states at once: a row of each.
        state = np.array(s, dtype=np.float64)
        state = state.reshape(1, -1)
        action = np.array(a, dtype=np.float64)
        action = action.reshape(1, -1)
        is_usable = action.shape[1] == m and np.isfinite(action).all()
        if not is_usable:
            raise QpError(
                f"action {action[0].tolist()} is not {m} finite numbers",
                status="bad action",
            )
        # An action that is not the policy's has no stored value: compute its expectation.
        (expected,) = self._operator.values(state, action, optimum.grid, optimum.W)
        (entries,) = state.tolist()
        penalty = problem.penalty(entries)
        return float(expected) - optimum.gain + penalty

    @cached_property
    def _operator(self) -> BellmanOperator:
        return BellmanOperator(self._plant, self.optimum.accuracy)


# a plant that changes -------------------------------------------------------------------------


def fouling(scenario: Scenario) -> tuple[str, Callable[[ArrayLike], Vector]] | None:
    """The plant's parameter p that fouls, the first uncertain one of its model, and p(t); or None.

    p(t) = p_clean (floor + (1 − floor) e^(−rate·τ)), t in s, τ days since the last cleaning. Raises
    OptimumError where there is no cleaning or no uncertain parameter.
    """
    given = scenario.plant.parameters
    rate = float(given.get("fouling_rate", 0.0))
    floor = float(given.get("fouling_floor", 0.7))
    period = float(given.get("cleaning_period", 0.0))
    # The plant does not foul, or does so without an effect.
    if rate == 0.0 or floor == 1.0:
        return None
    if not period > 0.0:
        raise OptimumError(
            "the quasi-static optimum needs a condenser that is cleaned: set "
            "plant.parameters.cleaning_period above 0"
        )
    model = _plant_model(scenario)
    if not model.uncertain:
        raise OptimumError(f"model '{model.name}' names no uncertain parameter that could foul")
    name = model.uncertain[0]
    clean = _parameter(scenario, model, name)

    def value(time: ArrayLike) -> Vector:
        days = np.asarray(time) / SECONDS_A_DAY
        since_cleaning = np.mod(days, period)
        decay = np.exp(-rate * since_cleaning)
        remaining = floor + (1.0 - floor) * decay
        return np.asarray(clean * remaining)

    return name, value


def _plant_model(scenario: Scenario) -> Model:
    """The model of a scenario's plant: `plant.model`, else the controller's."""
    return load_model(scenario.plant.model or scenario.controller.model)


@dataclass(frozen=True)
class Change:
    """A change that the reference knows, among `plants` that stay as they are.

    `parameters` are the values of what changes, by name; `position` says where among the plants the
    changing one is at times in s: 1.5 is midway between 1 and 2. A mean over time is that over
    `times` in s with `weights`.
    """

    plants: Sequence[Scenario]
    parameters: Mapping[str, Sequence[float]]
    position: Callable[[ArrayLike], Vector]
    times: Vector
    weights: Vector


def change_of(scenario: Scenario) -> Change | None:
    """Change of a scenario's plant, or None; raises OptimumError where it has two.

    A parameter that fouls goes through six values, from fouled to clean, in a cycle of cleaning.
    """
    fouled = fouling(scenario)
    if fouled and scenario.plant.changes:
        raise OptimumError("a condenser that fouls and plant.changes have no common reference")
    if fouled:
        return _fouling_change(scenario, *fouled)
    if scenario.plant.changes:
        return _jumps(scenario, scenario.plant.changes)
    return None


def _fouling_change(
    scenario: Scenario,
    name: str,
    value: Callable[[ArrayLike], Vector],
) -> Change:
    """The change of a parameter that fouls, whose values at times in s are `value(time)`."""
    cycle = SECONDS_A_DAY * scenario.plant.parameters["cleaning_period"]
    # A microsecond before the cleaning, and after it.
    fouled = value(cycle - 1e-6)
    clean = value(0.0)
    # Rounded: optima are stored by these values, whose last bits differ between processors.
    values = np.linspace(fouled, clean, FOULING_NODES).round(6)
    nodes = values.tolist()
    numbers = np.arange(FOULING_NODES)

    def position(time: ArrayLike) -> Vector:
        among_nodes = np.interp(value(time), nodes, numbers)
        return np.asarray(among_nodes, dtype=np.float64)

    # The mean over a cycle, whose integrand is smooth, by Gauss–Legendre.
    x, weights = np.polynomial.legendre.leggauss(40)
    # The rule's nodes are in [−1, 1], its weights sum to 2.
    times = 0.5 * cycle * (x + 1.0)
    return Change(
        plants=[frozen(scenario, name, node) for node in nodes],
        parameters={name: nodes},
        position=position,
        times=times,
        weights=weights / 2.0,
    )


def _jumps(scenario: Scenario, changes: Sequence[ChangeTable]) -> Change:
    """The changes of `plant.changes`, between which the plant stays as it is."""
    model = _plant_model(scenario)
    times = [change.time for change in changes]
    starts = np.array([0.0, *times])
    plants = [scenario.at(start) for start in starts.tolist()]
    parameters: dict[str, Sequence[float]] = {}
    for change in changes:
        for name in change.parameters:
            values = [_parameter(plant, model, name) for plant in plants]
            parameters[name] = values

    def position(time: ArrayLike) -> Vector:
        # The plant whose start was the last one.
        number = np.searchsorted(starts, time, side="right") - 1
        return np.asarray(number, dtype=np.float64)

    return Change(
        plants=plants,
        parameters=parameters,
        position=position,
        times=starts[:-1],
        # The last plant has no end, so it has no share of the mean.
        weights=np.diff(starts) / starts[-1],
    )


def frozen(
    scenario: Scenario,
    name: str,
    value: float,
) -> Scenario:
    """The scenario without fouling, its fouled parameter at a value.

    Args:
        scenario: The scenario.
        name: The parameter that fouls.
        value: Its value, in the model's unit.
    """
    # Through the document, so that the changed scenario is validated anew.
    document = scenario.to_dict()
    parameters = document["plant"]["parameters"]
    for fouling_parameter in FOULING_PARAMETERS:
        parameters.pop(fouling_parameter, None)
    parameters[name] = value
    return Scenario.from_dict(document)


def _parameter(
    scenario: Scenario,
    model: Model,
    name: str,
) -> float:
    """A plant parameter as the scenario sets it, else as the plant's model has it."""
    (index,) = model.parameter_indices((name,))
    nominal = model.nominal_parameters[index]
    return float(scenario.plant.parameters.get(name, nominal))


class QuasiStaticPolicy:
    """π*(s) of the plant as it is at the time; between the nodes of a law, linear in them.

    It knows the law of the change and the time, which `reset` sets to 0 and `prepare` advances by
    one sample. A reference, not a bound: it ignores changes to come. For a plant that changes
    infinitely slowly it is the optimum.
    """

    given = "truth"
    """Input of `feedback`, under sensors too: the optimum sees the state."""

    name = "optimal"

    def __init__(
        self,
        law: Change,
        policies: Sequence[OptimalPolicy],
        sampling_time: float,
    ) -> None:
        self.law = law
        self.policies = tuple(policies)
        self._h = sampling_time
        # The first `prepare` makes it 0.
        self._sample = -1

    @classmethod
    def from_scenario(
        cls,
        scenario: Scenario,
        *,
        progress: RoundProgress | None = None,
    ) -> QuasiStaticPolicy:
        """Policy of a scenario whose plant changes; optima that are not stored are solved.

        Args:
            scenario: The scenario.
            progress: Called after each round of the solver.

        Raises:
            OptimumError: The plant changes in two ways, or an optimum is not solved.
        """
        law = change_of(scenario)
        assert law is not None
        policies = []
        for plant in law.plants:
            policies.append(OptimalPolicy.from_scenario(plant, progress=progress))
        return cls(law, policies, scenario.sampling_time)

    @property
    def gains(self) -> list[float]:
        """J* of each of the law's plants."""
        return [policy.gain for policy in self.policies]

    @property
    def gain(self) -> float:
        """Mean of J* over one cycle of fouling, or from the start to the last jump."""
        gains = self.gain_at(self.law.times)
        return float(gains @ self.law.weights)

    def gain_at(self, time: ArrayLike) -> Vector:
        """J* of the plant as it is at times in s, between the nodes by monotone cubics."""
        from scipy.interpolate import PchipInterpolator  # noqa: PLC0415 - half a second

        nodes = np.arange(len(self.policies))
        # Another cubic could overshoot between the nodes.
        interpolate = PchipInterpolator(nodes, self.gains)
        gains: Vector = interpolate(self.law.position(time))
        return gains

    def reset(self) -> None:
        """Start the clock."""
        self._sample = -1

    def prepare(self) -> None:
        """Advance the clock by one sample."""
        self._sample += 1

    def feedback(self, s: ArrayLike, a: ArrayLike | None = None) -> Decision:
        """Action and value for the plant as it is at the time; raises QpError as each policy does.

        Args:
            s: State in the model's units, (n,).
            a: Action to enforce, (m,).
        """
        # The position is between two plants; its fraction is the share of the second.
        time = max(self._sample, 0) * self._h
        share, whole = modf(self.law.position(time))
        lower = int(whole)
        first = self.policies[lower].feedback(s, a)
        if share == 0.0:
            return first
        second = self.policies[lower + 1].feedback(s, a)
        rest = 1.0 - share
        clamped = "clamped" in (first.status, second.status)
        return Decision(
            action=rest * first.action + share * second.action,
            value=rest * first.value + share * second.value,
            status="clamped" if clamped else "solved",
            residual=0.0,
        )
