"""A controller's own model of a plant, as CasADi expressions with named quantities.

Runge-Kutta steps make it discrete; `measure_integration` says how far these are from the model's
own solution over a sample.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from math import isfinite
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.errors import ModelError
from cosim.core.modules import exception_line
from cosim.core.protocols import Array

KINDS = ("states", "actions", "disturbances", "parameters")
"""The kinds of a model's quantities, in the order of its functions' arguments."""

ModelExpression = Callable[[ca.SX, ca.SX, ca.SX, ca.SX], ca.SX]
"""A function (x, u, d, p) of a model."""

TEMPERATURES = ("K", "degC", "degF", "°C", "°F")
"""Units whose zero is not that of the quantity's variation."""
INTEGRATION_TOLERANCE = 0.01
"""Share of a state's range by which a sample's prediction may be off without a word."""
MAX_SUBSTEPS = 1000
"""Most substeps that are tried."""
MAX_CORNERS = 16
"""Most corners of the bounds that are tried; of more, each bound alone."""
GROWTH_MARGIN = 1e-6
"""Least growth of a mode above 1 that counts: rounding is below."""


REMEDIES = (
    (
        "truth value",
        "it asks whether an expression is true, by if, max, min, and, or: "
        "use casadi.if_else, fmax, fmin, logic_and, logic_or",
    ),
    (
        "'SX' and 'MX'|'MX' and 'SX'",
        "it mixes MX symbols with its arguments, which are SX: use x, u, d and p alone",
    ),
    (
        "[Oo]ut of bounds",
        "it reads an entry that x, u, d or p does not have: they are as long as the model's "
        "quantities",
    ),
    (
        "positional argument|keyword argument",
        "it must take four arguments (x, u, d, p), whether it uses them or not",
    ),
    (
        "must be real number|float\\(\\)|convert .* to .*float|only (length-1|0-dimensional)|"
        "ufunc|loop of",
        "it uses a function of numbers, of math or NumPy, on an expression: use CasADi's",
    ),
)
"""Meanings of exceptions in a model's function, by a pattern of their texts."""


@dataclass(frozen=True)
class Quantity:
    """A quantity of a model.

    Attributes:
        name: of the quantity.
        unit: of its values.
        nominal: its nominal value.
        magnitude: of a disturbance, the size of which its guessed deviation is 10 %; the nominal
            value's if not given. A temperature needs one: the zero of its unit says nothing of
            its size.
        deviation: of a state or an action, the deviation that weighs as much as those of the
            others, where the economic tuning makes the cost convex; the width of its bounds if
            not given.
    """

    name: str
    unit: str
    nominal: float = 0.0
    magnitude: float | None = None
    deviation: float | None = None


@dataclass(frozen=True)
class ModelFunction:
    """A function (x, u, d, p) → column of a model, as its user wrote it.

    A call accepts what is a column without doubt, an expression (rows, 1) or a list, tuple or array
    of `rows` scalars, and returns it as a CasADi column. Anything else is a ModelError, whose one
    line names the model, the function, what is wrong and how to mend it.
    """

    function: Callable[..., Any]
    name: str
    model: str
    rows: int

    def __call__(self, x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
        """The column (rows, 1) at x, u, d and p, symbols or numbers."""
        try:
            # Copies: what the function writes into its arguments stays its own.
            arguments = [_copy(argument) for argument in (x, u, d, p)]
            result = self.function(*arguments)
            column: Any = _column(result)
        except ModelError:
            # A model inside of this one has said already what is wrong.
            raise
        except Exception as error:  # the user's code may raise anything
            raise self.error(_meaning(error)) from error
        if column is None:
            raise self.error(
                f"it returned {_words(result)} in place of {self._wanted()}: {self._remedy()}"
            )
        if column.shape != (self.rows, 1):
            rows, columns = column.shape
            if columns != 1:
                counted = f"a matrix of {rows} rows and {columns} columns"
            elif rows != 1:
                counted = f"{rows} expressions"
            else:
                counted = "1 expression"
            raise self.error(
                f"it returned {counted} in place of {self._wanted()}: {self._remedy()}"
            )
        checked: ca.SX = column
        return checked

    def check(self, symbols: Sequence[ca.SX]) -> None:
        """Call it once with the symbols (x, u, d, p); raises ModelError on what cannot be used."""
        column = self(*symbols)
        # CasADi would only say that types do not match, in some later call.
        if isinstance(column, ca.MX):
            raise self.error(
                "it returned an MX expression: build it of x, u, d and p, which are SX, alone"
            )
        # Free symbols are allowed here to be named below.
        function = ca.Function(
            "checked",
            list(symbols),
            [ca.SX(column)],
            {"allow_free": True},
        )
        # A symbol of somebody else's would have no value in any later call.
        free = [str(symbol) for symbol in function.get_free()]
        if free:
            raise self.error(
                f"it depends on {', '.join(free)}, which is no entry of x, u, d or p: "
                "make it a parameter or a disturbance of the model, or give it a number"
            )
        # A constant that is not finite would be a NaN in every QP, far from its cause.
        for k in range(function.n_instructions()):
            if function.instruction_id(k) != ca.OP_CONST:
                continue
            constant = function.instruction_constant(k)
            if not isfinite(constant):
                raise self.error(
                    f"it contains the constant {constant}: look for a division by zero, a number "
                    "that is missing, or math.… or float(…) of an expression"
                )

    def error(self, reason: str) -> ModelError:
        """A ModelError about this function."""
        return ModelError(f"model '{self.model}', {self.name}(x, u, d, p): {reason}")

    def _wanted(self) -> str:
        if self.rows == 1:
            return "one expression"
        return f"{self.rows} expressions, one a state"

    def _remedy(self) -> str:
        if self.name == "ode":
            return "return casadi.vertcat(…) with the rate of each state in their order"
        return "return one scalar, the cost of a sample"


def _copy(argument: Any) -> Any:
    if isinstance(argument, ca.SX | ca.MX | ca.DM):
        # A slice of all is a copy.
        return argument[:, :]
    return argument


def _column(result: Any) -> Any:
    """Result of a function as a CasADi column; None where it is none."""
    if isinstance(result, ca.SX | ca.MX | ca.DM):
        return result
    if isinstance(result, np.ndarray):
        # NumPy users write columns, whose entries may be expressions.
        if result.ndim == 2 and result.shape[1] == 1:
            result = result[:, 0]
        if result.ndim > 1:
            return None
        result = result.tolist()  # a list, or a number
    if isinstance(result, list | tuple):
        return ca.vertcat(*result)
    # A comparison that Python has made is a bool, and no cost.
    if isinstance(result, bool):
        return None
    if isinstance(result, int | float | np.number):
        return ca.SX(float(result))
    return None


def _words(result: Any) -> str:
    if result is None:
        return "None"
    kind = type(result).__name__
    if isinstance(result, np.ndarray):
        return f"{kind} of shape {result.shape}"
    return kind


def _meaning(error: Exception) -> str:
    """Error in a function and its remedy, where one is known, in one line."""
    for pattern, remedy in REMEDIES:
        if re.search(pattern, str(error)):
            return f"{remedy} ({_short(error)})"
    return f"it cannot be called with symbols: {_short(error)}"


def _short(error: Exception) -> str:
    """The exception in one line, without CasADi's lists of prototypes."""
    line = exception_line(error)
    # The place in the user's file, which ends the line, stays.
    words, bracket, place = line.rpartition(" (")
    if len(words) > 160:
        words = f"{words[:157]}…"
    return f"{words}{bracket}{place}"


@dataclass(frozen=True)
class Model:
    """A continuous-time model x' = ode(x, u, d, p) with the economic cost ℓ(x, u, d, p).

    The states x, actions u, disturbances d and parameters p are columns in the order of their
    quantities. `ode` and `economic_cost` are called once with symbols when the model is made.

    Args:
        name: Name of the model, for messages.
        states: Quantities of x.
        actions: Quantities of u.
        disturbances: Quantities of d, whose nominal values the controller predicts with.
        parameters: Quantities of p.
        ode: Function (x, u, d, p) that returns a column of n expressions, or a list, tuple or array
            of n scalars: the rates of the states.
        economic_cost: Function (x, u, d, p) that returns one scalar ℓ.
        time_unit: Length in seconds of the unit of time in which `ode` counts.
        outputs: Functions (x, u, d, p) of what is measured and is no state, one scalar each, by the
            name of the plant's variable. They may depend on x and p alone: a reading is taken
            before the sample's action is known.
        uncertain: Names of the parameters that a plant may well have otherwise, which
            identification fits where it is not said which.

    Raises:
        ModelError: A function fails, returns something else or depends on what is no entry of x, u,
            d and p, or names, values or units do not fit.

    Example:
        >>> rate = lambda x, u, d, p: (u[0] + d[0] - x[0]) / p[0]
        >>> cost = lambda x, u, d, p: x[0] ** 2 + u[0] ** 2
        >>> level, inflow, rain = Quantity("h", "m"), Quantity("q", "m"), Quantity("d", "m")
        >>> area = Quantity("A", "m2", 2.0)
        >>> model = Model("tank", (level,), (inflow,), (rain,), (area,), rate, cost)
        >>> model.nominal_parameters
        array([2.])
    """

    name: str
    states: tuple[Quantity, ...]
    actions: tuple[Quantity, ...]
    disturbances: tuple[Quantity, ...]
    parameters: tuple[Quantity, ...]
    ode: ModelExpression = field(repr=False)
    economic_cost: ModelExpression = field(repr=False)
    time_unit: float = 1.0
    uncertain: tuple[str, ...] = ()
    outputs: Mapping[str, ModelExpression] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        for kind in KINDS:
            # Tuples, whatever sequence was given: a frozen model stays as it was checked.
            object.__setattr__(self, kind, self._quantities(kind))
        # Scenarios, files and messages know a quantity by its name alone.
        names: list[str] = []
        for kind in KINDS:
            quantities = getattr(self, kind)
            names += [quantity.name for quantity in quantities]
        doubled = {name for name in names if names.count(name) > 1}
        if doubled:
            listed = ", ".join(sorted(doubled))
            raise ModelError(
                f"model '{self.name}': {listed} is the name of more than one quantity; "
                "give each a name of its own"
            )
        for kind in ("states", "actions"):
            if not getattr(self, kind):
                raise ModelError(f"model '{self.name}' has no {kind}; it needs at least one")
        if not _is_positive(self.time_unit):
            raise ModelError(
                f"model '{self.name}': time_unit must be positive seconds, not {self.time_unit!r}"
            )
        object.__setattr__(self, "uncertain", tuple(self.uncertain))
        # Raises where a name is no parameter's.
        self.parameter_indices(self.uncertain)
        # Called once with symbols: a mistake is reported where the model is made.
        ode = self._checked("ode", self.ode, len(self.states))
        object.__setattr__(self, "ode", ode)
        economic_cost = self._checked("economic_cost", self.economic_cost, 1)
        object.__setattr__(self, "economic_cost", economic_cost)
        outputs = {}
        for output, function in self.outputs.items():
            checked = self._checked(f"outputs['{output}']", function, 1)
            self._check_output(checked)
            outputs[output] = checked
        object.__setattr__(self, "outputs", outputs)

    def _checked(
        self,
        name: str,
        function: object,
        rows: int,
    ) -> ModelFunction:
        """A function of the model that returns a column of so many rows; raises ModelError."""
        if not callable(function):
            raise ModelError(
                f"model '{self.name}': {name} must be a function (x, u, d, p), "
                f"not {type(function).__name__}"
            )
        if isinstance(function, ModelFunction):  # of a copy
            function = function.function
        checked = ModelFunction(function, name, self.name, rows)
        checked.check(self.symbols())
        return checked

    def _check_output(self, output: ModelFunction) -> None:
        """Refuse an output that depends on what is not known when it is measured."""
        x, u, d, p = self.symbols()
        expression = output(x, u, d, p)
        not_known_yet = ca.vertcat(u, d)
        if ca.depends_on(expression, not_known_yet):
            raise output.error(
                "it depends on u or d, which act after the reading is taken: a measured output is "
                "a function of x and p"
            )

    def _quantities(self, kind: str) -> tuple[Quantity, ...]:
        given = getattr(self, kind)
        # A tuple of one is easily written without its comma.
        if isinstance(given, Quantity) or not isinstance(given, list | tuple):
            raise ModelError(
                f"model '{self.name}': {kind} must be a tuple of controllers.Quantity, "
                f"not {type(given).__name__}; one alone is written (Quantity(…),)"
            )
        for quantity in given:
            if not isinstance(quantity, Quantity):
                raise ModelError(
                    f"model '{self.name}': {kind} must hold controllers.Quantity, not {quantity!r}"
                )
            if not (isinstance(quantity.name, str) and quantity.name):
                raise ModelError(
                    f"model '{self.name}': one of the {kind} has no name: {quantity!r}"
                )
            try:
                # A user may have written anything, which need not be a number.
                finite = isfinite(quantity.nominal)
            except TypeError:
                finite = False
            if not finite:
                raise ModelError(
                    f"model '{self.name}': the nominal value of {quantity.name} must be a finite "
                    f"number, not {quantity.nominal!r}"
                )
            for attribute in ("magnitude", "deviation"):
                size = getattr(quantity, attribute)
                if size is not None and not _is_positive(size):
                    raise ModelError(
                        f"model '{self.name}': the {attribute} of {quantity.name} must be a "
                        f"positive number, not {size!r}"
                    )
        return tuple(given)

    @property
    def variable_units(self) -> dict[str, str]:
        """Unit of each state and action, by name."""
        quantities = (*self.states, *self.actions)
        return {quantity.name: quantity.unit for quantity in quantities}

    @property
    def nominal_disturbance(self) -> NDArray[np.float64]:
        """Nominal disturbance, shape (n_d,)."""
        return np.array([quantity.nominal for quantity in self.disturbances])

    @property
    def disturbance_magnitudes(self) -> NDArray[np.float64]:
        """Magnitude of each disturbance, shape (n_d,), on which no unit decides.

        Raises:
            ModelError: a temperature has none.
        """
        magnitudes = []
        for quantity in self.disturbances:
            magnitude = quantity.magnitude
            # Zero degrees is a place on a scale, not nothing.
            if magnitude is None and quantity.unit in TEMPERATURES:
                raise ModelError(
                    f"model '{self.name}': the disturbance {quantity.name} is a temperature in "
                    f"{quantity.unit}, and its size does not follow from the nominal value; add "
                    "magnitude=… to its Quantity, ten times the expected deviation"
                )
            if magnitude is None:
                magnitude = abs(quantity.nominal)
            magnitudes.append(magnitude)
        return np.array(magnitudes)

    @property
    def nominal_parameters(self) -> NDArray[np.float64]:
        """Nominal parameter values, shape (n_p,)."""
        return np.array([quantity.nominal for quantity in self.parameters])

    def parameter_indices(self, names: tuple[str, ...]) -> list[int]:
        """Positions of the named parameters in p; ModelError if one is unknown or doubled."""
        known = [quantity.name for quantity in self.parameters]
        if len(set(names)) < len(names):
            raise ModelError(f"model parameters must be named once each: {', '.join(names)}")
        for name in names:
            if name not in known:
                raise ModelError(
                    f"model '{self.name}' has no parameter '{name}'; "
                    f"it has {', '.join(known) or 'none'}"
                )
        return [known.index(name) for name in names]

    def measuring(self, names: tuple[str, ...]) -> Model:
        """Copy whose named disturbances are its last parameters, so that θ may hold them.

        Raises ModelError where a name is no disturbance of the model, or comes twice.
        """
        moved = [quantity for quantity in self.disturbances if quantity.name in names]
        rest = [quantity for quantity in self.disturbances if quantity.name not in names]
        if len(moved) != len(names):
            raise ModelError(f"model '{self.name}' has not all of {', '.join(names)} to measure")
        # Where each of the present disturbances is among those that stay and those that moved.
        rearranged_order = [*rest, *moved]
        order = [rearranged_order.index(quantity) for quantity in self.disturbances]
        count = len(self.parameters)

        def rearranged(expression: ModelExpression) -> ModelExpression:
            def call(x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
                # The model's own functions still get what they were written for.
                own_parameters = p[:count]
                measured = p[count:]
                disturbances = ca.vertcat(d, measured)[order]
                return expression(x, u, disturbances, own_parameters)

            return call

        outputs = {}
        for name, output in self.outputs.items():
            outputs[name] = rearranged(output)
        return replace(
            self,
            disturbances=tuple(rest),
            parameters=(*self.parameters, *moved),
            ode=rearranged(self.ode),
            economic_cost=rearranged(self.economic_cost),
            outputs=outputs,
        )

    def symbols(self) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX]:
        """Fresh symbols (x, u, d, p)."""
        return (
            ca.SX.sym("x", len(self.states)),
            ca.SX.sym("u", len(self.actions)),
            ca.SX.sym("d", len(self.disturbances)),
            ca.SX.sym("p", len(self.parameters)),
        )


def _is_positive(value: object) -> bool:
    """Whether a value is a positive finite number."""
    return isinstance(value, int | float) and 0 < value < float("inf")


def by_name(quantities: Sequence[Quantity], column: ca.SX) -> dict[str, ca.SX]:
    """The entries of a column by the names of its quantities.

    Args:
        quantities: One for each entry.
        column: x, u, d or p, as a model's functions get them.
    """
    entries = {}
    for i, quantity in enumerate(quantities):
        entries[quantity.name] = column[i]
    return entries


def runge_kutta(
    rate: Callable[[Any], Any],
    x: Any,
    h: float | ca.SX,
    substeps: int,
) -> Any:
    """x after some classical RK4 steps of x' = rate(x).

    Args:
        rate: Right-hand side, of symbols or of arrays.
        x: Start: a vector, or vectors side by side; symbols or an array.
        h: Length of a step.
        substeps: Number of steps.
    """
    for _ in range(substeps):
        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        k4 = rate(x + h * k3)
        slopes = k1 + 2 * k2 + 2 * k3 + k4
        x = x + h / 6 * slopes
    return x


def discretise(
    model: Model,
    sampling_time: float,
    substeps: int,
) -> ca.Function:
    """Discrete-time model f(x, u, d, p) → x₊ for inputs held over one sample.

    Args:
        model: The model.
        sampling_time: Length of a sample in s.
        substeps: Number of RK4 steps a sample.
    """
    x, u, d, p = model.symbols()
    # A sample is in seconds, the model's rates in its own unit of time.
    h = sampling_time / model.time_unit / substeps

    def rate(state: ca.SX) -> ca.SX:
        return model.ode(state, u, d, p)

    x_next = runge_kutta(rate, x, h, substeps)
    return ca.Function(
        "f",
        [x, u, d, p],
        [x_next],
        ["x", "u", "d", "p"],
        ["x_next"],
    )


def economic_cost(model: Model) -> ca.Function:
    """Economic cost ℓ(x, u, d, p) as a CasADi function."""
    symbols = model.symbols()
    cost = model.economic_cost(*symbols)
    return ca.Function("l", list(symbols), [cost])


@dataclass(frozen=True)
class Integration:
    """The largest error of a sample's prediction, as a share of the ranges of the states.

    `error` is that of x₊ and, at the reference, of its derivatives by (x, u), each times the width
    of its bounds.
    `state` names the state where it is largest, `at_reference` says whether that is at the
    reference or at the bounds. `suffices` is a number of substeps, the given one doubled and
    doubled again, whose error is below `INTEGRATION_TOLERANCE`; None where `MAX_SUBSTEPS` is not
    enough. `unstable` says whether a mode that decays at the reference grows in the prediction.
    """

    error: float
    state: str
    at_reference: bool
    suffices: int | None
    unstable: bool

    @property
    def coarse(self) -> bool:
        """Whether the error is above `INTEGRATION_TOLERANCE`."""
        return not self.error <= INTEGRATION_TOLERANCE

    @property
    def remedy(self) -> str:
        """Remedy of a coarse integration, in a few words."""
        if self.suffices is None:
            return (
                f"even substeps = {MAX_SUBSTEPS} is too few: replace the fast states by what they "
                "settle at"
            )
        return f"set substeps = {self.suffices} in the table [controller]"


class _Predictor:
    """A sample of the nominal model and its derivatives, at many points at once."""

    def __init__(self, model: Model, sampling_time: float) -> None:
        x, u, d, p = model.symbols()
        rate = model.ode(x, u, d, p)
        point = ca.vertcat(x, u)
        jacobian = ca.jacobian(rate, point)
        slope = ca.vec(jacobian)
        results = [ca.densify(rate), ca.densify(slope)]
        rates = ca.Function("rates", [x, u, d, p], results)
        # The nominal d and p are the same at all points.
        nominal_d = ca.SX(ca.DM(model.nominal_disturbance))
        nominal_p = ca.SX(ca.DM(model.nominal_parameters))
        at_nominal: Any = rates(x, u, nominal_d, nominal_p)
        self._rates = ca.Function("rates", [x, u], at_nominal)
        self.length = sampling_time / model.time_unit

    def slopes(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Rates of the states and their derivatives by (x, u) at P points.

        Args:
            x: States, (P, n).
            u: Actions, (P, m).

        Returns:
            The rates (P, n), and the derivatives (P, n, n+m).
        """
        count, n = x.shape
        # CasADi has a point in each column, and stacks a derivative's columns.
        rates, slopes = self._rates(x.T, u.T)
        stacked = slopes.full().T
        by_columns = stacked.reshape(count, -1, n)
        return rates.full().T, by_columns.transpose(0, 2, 1)

    def modes(self, x: Array, u: Array) -> NDArray[np.complex128]:
        """Eigenvalues (P, n) of the rates' derivatives by x; 0 where these are not finite.

        Args:
            x: States, (P, n).
            u: Actions, (P, m).
        """
        n = x.shape[1]
        _, slopes = self.slopes(x, u)
        by_state = slopes[:, :, :n]
        # An eigenvalue solver raises its own error on what is not finite.
        usable = by_state.copy()
        usable[~_finite(by_state)] = 0.0
        eigenvalues = np.linalg.eigvals(usable)
        return eigenvalues.astype(complex)

    def __call__(
        self,
        x: Array,
        u: Array,
        substeps: int,
    ) -> Array:
        """x₊ and its derivatives by (x, u) side by side, (P, n, 1+n+m)."""
        count, n = x.shape
        m = u.shape[1]
        # The action is held: its own derivative by (x, u) is (0, I).
        by_state_of_held = np.zeros((m, n))
        by_action_of_held = np.eye(m)
        held_jacobian = np.hstack([by_state_of_held, by_action_of_held])
        # A state and its derivatives side by side, which the variational equation carries on.
        state = np.zeros((count, n, 1 + n + m))
        state[:, :, 0] = x
        state[:, :, 1 : 1 + n] = np.eye(n)
        h = self.length / substeps

        def rate(state: Array) -> Array:
            present_x = state[:, :, 0]
            jacobian = state[:, :, 1:]
            value, slope = self.slopes(present_x, u)
            # The variational equation: d/dt ∂x = (∂f/∂x) ∂x + (∂f/∂u) ∂u.
            by_state = slope[:, :, :n]
            by_action = slope[:, :, n:]
            from_state = by_state @ jacobian
            from_action = by_action @ held_jacobian
            variation = from_state + from_action
            column = value[:, :, None]
            return np.concatenate([column, variation], axis=2)

        carried: Array = runge_kutta(rate, state, h, substeps)
        return carried


def measure_integration(
    model: Model,
    sampling_time: float,
    substeps: int,
    reference: Array,
    lower: Array,
    upper: Array,
) -> Integration:
    """Compare a sample's prediction with those of twice, four times … as many substeps.

    That is at the reference and at corners of the bounds. A corner from which the model's own
    solution is not finite is passed over.

    Args:
        model: The model.
        sampling_time: Length of a sample in s.
        substeps: Number of RK4 steps a sample.
        reference: (x, u), (n+m,).
        lower: Lower bounds of (x, u), (n+m,).
        upper: Upper bounds of (x, u), (n+m,).
    """
    n = len(model.states)
    points = _points(reference, lower, upper)
    x = points[:, :n]
    u = points[:, n:]
    predict = _Predictor(model, sampling_time)
    modes = predict.modes(x, u)
    length = predict.length
    widths = upper - lower
    # A derivative counts as what it makes of the whole width of the bounds.
    widths_of_states = widths[:n, None]
    scale = np.hstack([1.0, widths]) / widths_of_states
    suffices = None
    n_steps = substeps
    with np.errstate(all="ignore"):  # a prediction that runs away is a result here
        coarse = predict(x, u, n_steps)
        present = coarse
        while n_steps <= MAX_SUBSTEPS:
            finer = predict(x, u, 2 * n_steps)
            grows = _grows(modes, length / n_steps)
            largest = _errors(present, finer, scale, grows).max()
            # Half of the tolerance: the finer prediction, which is compared with, is off too.
            if largest <= INTEGRATION_TOLERANCE / 2:
                suffices = n_steps
                break
            n_steps = 2 * n_steps
            present = finer
        grows = _grows(modes, length / substeps)
        errors = _errors(coarse, finer, scale, grows)
    place = int(errors.argmax())
    point, state = np.unravel_index(place, errors.shape)
    return Integration(
        error=float(errors.max()),
        state=model.states[state].name,
        at_reference=bool(point == 0),
        suffices=suffices,
        unstable=bool(grows[0]),
    )


def _points(
    reference: Array,
    lower: Array,
    upper: Array,
) -> Array:
    """The reference, then corners of the bounds of (x, u), one a row."""
    # The number of corners doubles with each state and action.
    n_corners = 2 ** len(lower)
    if n_corners <= MAX_CORNERS:
        bounds = zip(lower, upper, strict=True)
        corners = list(product(*bounds))
    else:
        corners = []
        for i in range(len(lower)):
            for bound in (lower[i], upper[i]):
                corner = reference.copy()
                corner[i] = bound
                corners.append(tuple(corner))
    return np.array([reference, *corners])


def _errors(
    present: Array,
    finer: Array,
    scale: Array,
    grows: NDArray[np.bool_],
) -> Array:
    """Errors (P, n) of predictions (P, n, 1+n+m) that have finer ones.

    Where there is no finite one the error is infinite if a mode `grows` (P,), else the solution of
    the model is not finite either, and the error is 0.
    """
    parts = np.abs(finer - present) * scale
    # Derivatives count at the reference alone: at a corner a table's kinks are no lack of substeps.
    at_reference = parts[:1].max(axis=2)
    at_corners = parts[1:, :, 0]
    errors = np.concatenate([at_reference, at_corners])
    errors = np.where(np.isfinite(errors), errors, np.inf)
    without_finer = np.where(grows, np.inf, 0.0)
    finite = _finite(finer)
    by_state = np.where(finite[:, None], errors, without_finer[:, None])
    return np.asarray(by_state)


def _finite(values: Array) -> NDArray[np.bool_]:
    """Whether all entries are finite, of each of P points (P, …)."""
    by_point = values.reshape(len(values), -1)
    finite = np.isfinite(by_point)
    all_finite: NDArray[np.bool_] = np.array(finite.all(axis=1))
    return all_finite


def _grows(modes: NDArray[np.complex128], h: float) -> NDArray[np.bool_]:
    """Whether of modes (P, n) one that decays is outside of the stability region of a step h."""
    # The stability function of RK4: what a step makes of a mode.
    z = modes * h
    factor = 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24
    growth = np.abs(factor)
    decays = modes.real < 0
    grows_in_steps = growth > 1 + GROWTH_MARGIN
    wrong = decays & grows_in_steps
    return np.asarray(wrong.any(axis=1))
