"""A controller's own model of a plant, as CasADi expressions with named quantities."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import isfinite

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.errors import ModelError
from controllers.model_function import ModelFunction

KINDS = ("states", "actions", "disturbances", "parameters")
"""The kinds of a model's quantities, in the order of its functions' arguments."""

ModelExpression = Callable[[ca.SX, ca.SX, ca.SX, ca.SX], ca.SX]
"""A function (x, u, d, p) of a model."""

TEMPERATURES = ("K", "degC", "degF", "°C", "°F")
"""Units whose zero is not that of the quantity's variation."""


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
    """

    name: str
    unit: str
    nominal: float = 0.0
    magnitude: float | None = None


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

    def __post_init__(self) -> None:
        for kind in KINDS:
            object.__setattr__(self, kind, self._quantities(kind))
        names: list[str] = []
        for kind in KINDS:
            names += [quantity.name for quantity in getattr(self, kind)]
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise ModelError(
                f"model '{self.name}': {', '.join(doubled)} is the name of more than one quantity; "
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
        self.parameter_indices(self.uncertain)
        for name, rows in (("ode", len(self.states)), ("economic_cost", 1)):
            function = getattr(self, name)
            if not callable(function):
                raise ModelError(
                    f"model '{self.name}': {name} must be a function (x, u, d, p), "
                    f"not {type(function).__name__}"
                )
            if isinstance(function, ModelFunction):  # of a copy
                function = function.function
            checked = ModelFunction(function, name, self.name, rows)
            checked.check(self.symbols())
            object.__setattr__(self, name, checked)

    def _quantities(self, kind: str) -> tuple[Quantity, ...]:
        given = getattr(self, kind)
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
                finite = isfinite(quantity.nominal)
            except TypeError:
                finite = False
            if not finite:
                raise ModelError(
                    f"model '{self.name}': the nominal value of {quantity.name} must be a finite "
                    f"number, not {quantity.nominal!r}"
                )
            magnitude = quantity.magnitude
            if magnitude is not None and not _is_positive(magnitude):
                raise ModelError(
                    f"model '{self.name}': the magnitude of {quantity.name} must be a positive "
                    f"number, not {magnitude!r}"
                )
        return tuple(given)

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
            if magnitude is None and quantity.unit in TEMPERATURES:
                raise ModelError(
                    f"model '{self.name}': the disturbance {quantity.name} is a temperature in "
                    f"{quantity.unit}, whose nominal value says nothing of its size; add "
                    "magnitude=… to its Quantity, ten times the deviation that you expect"
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
                own_parameters = p[:count]
                measured = p[count:]
                disturbances = ca.vertcat(d, measured)[order]
                return expression(x, u, disturbances, own_parameters)

            return call

        return replace(
            self,
            disturbances=tuple(rest),
            parameters=(*self.parameters, *moved),
            ode=rearranged(self.ode),
            economic_cost=rearranged(self.economic_cost),
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
    rate: Callable[[ca.SX], ca.SX],
    x: ca.SX,
    h: float | ca.SX,
    substeps: int,
) -> ca.SX:
    """x after some classical RK4 steps of x' = rate(x).

    Args:
        rate: Right-hand side.
        x: Start: a vector, or vectors side by side.
        h: Length of a step.
        substeps: Number of steps.
    """
    for _ in range(substeps):
        k1 = rate(x)
        k2 = rate(x + h / 2 * k1)
        k3 = rate(x + h / 2 * k2)
        k4 = rate(x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x


def discretise(model: Model, sampling_time: float, substeps: int) -> ca.Function:
    """Discrete-time model f(x, u, d, p) → x₊ for inputs held over one sample.

    Args:
        model: The model.
        sampling_time: Length of a sample in s.
        substeps: Number of RK4 steps a sample.
    """
    x, u, d, p = model.symbols()
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
