"""The task that a controller is given, in its own units; and the same with the plant's model.

What signals say of a problem differs from stage to stage of the horizon (`Varying`). What depends
on a problem's content alone is built once (`built_once`).
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, lru_cache, wraps
from math import exp, isfinite, sqrt
from pathlib import Path
from typing import Concatenate, Literal, NamedTuple, ParamSpec, TypeVar

import casadi as ca
import daqp
import numpy as np
from numpy.typing import ArrayLike

import fmus
from controllers.errors import ModelError, OptimumError
from controllers.functions import not_in_c
from controllers.memory import Memory, remember
from controllers.model import KINDS, Model, discretise
from controllers.qp import DAQP_FIXED, DAQP_SETTINGS, DAQP_STATUS, Mask
from cosim.core.modules import exception_line, load_plugin
from cosim.core.protocols import Matrix, Vector
from cosim.core.scenario import Penalty, Scenario, SignalTable
from cosim.core.validation import instead
from fmus.states import continuous_states, time_constants

VECTORS = (
    "state_lower",
    "state_upper",
    "action_lower",
    "action_upper",
    "penalty_linear",
    "penalty_quadratic",
    "reference_state",
    "reference_action",
)
"""A problem's vectors, by state but for the actions'."""
ACTIVE_SHARE = 1e-6
"""Share of a bound's width within which the reference counts as at the bound."""


@dataclass(frozen=True)
class Units:
    """The units `state` ρ_x (n,), `action` ρ_u (m,), `cost` κ; and `largest_multiplier`.

    The last is max_i μ_i ρ_i with the multipliers μ of the state bounds at the reference; κ is the
    power of ten above it, so that slack weights κ/ρ_x are exact penalties. Where no bound is active
    it is 0, and κ is that of the cost's curvature, max_i |∂²ℓ/∂w_i²| ρ_i², or of the cost itself.
    """

    state: Vector
    action: Vector
    cost: float
    largest_multiplier: float

    @classmethod
    def from_problem(cls, problem: Problem) -> Units:
        """Units of a problem; raises ModelError where the multipliers cannot be computed."""
        n = problem.n_states
        # The units of states and actions are the powers of ten nearest to their bounds' widths.
        widths = problem.upper - problem.lower
        powers = np.rint(_power(widths))
        both = np.array([10.0**power for power in powers])
        sizes = _cost_sizes(problem, both)
        cost = 1.0
        if sizes:  # the first one is what the cost is counted in
            first = next(iter(sizes.values()))
            power_below = np.floor(_power(first))
            power_above = power_below + 1
            cost = float(10.0**power_above)
        return cls(
            state=both[:n],
            action=both[n:],
            cost=cost,
            largest_multiplier=sizes.get("multiplier", 0.0),
        )

    def exact_penalty_weights(self) -> Vector:
        """Slack weights just above the multipliers, to two digits, (n,): the least exact ones.

        Where no bound is active any positive ones are: a thousandth of κ/ρ_x.
        """
        largest = self.largest_multiplier
        if not largest:
            return 1e-3 * self.cost / self.state
        # A step of the second digit more than what two digits hold: above it in any case.
        first_power = np.floor(_power(largest))
        digit = 10.0 ** (first_power - 1)
        two_digits = np.floor(largest / digit)
        rounded_up = (two_digits + 1) * digit
        return np.asarray(rounded_up / self.state)


@dataclass(frozen=True)
class Scale:
    """The one scaling of the controller's QP: x = `state`·x̃, u = `action`·ũ, cost = `cost`·c̃.

    `state` (n,) and `action` (m,) are powers of two and `cost` is a power of four, so that scaling
    changes no digit, in a Cholesky factor neither. They are those nearest to `ranges` (n+m,) and
    `level`, which a change of units multiplies by exactly its own factors: what must not depend on
    the units at all, such as the metric of `Exact`, is taken relative to these.
    """

    state: Vector
    action: Vector
    cost: float
    ranges: Vector
    level: float

    @classmethod
    def from_problem(cls, problem: Problem) -> Scale:
        """Scale of a problem: the widths between its bounds, and the size of its cost over them.

        A state's range is at most a hundred times the violation at which the penalty's quadratic
        term reaches the linear one, for a bound that is only there to be far away.
        """
        n = problem.n_states
        ranges = problem.upper - problem.lower
        # A bound that is only there to be far away says nothing of the range of a state.
        steep = 100.0 * problem.penalty_linear / problem.penalty_quadratic
        ranges[:n] = np.minimum(ranges[:n], steep)
        try:
            sizes = _cost_sizes(problem, ranges)
        except ModelError:  # a size of the cost is wanted here, not its multipliers
            sizes = {}
        # The sizes come in the order in which they say most.
        level = next(iter(sizes.values()), 1.0)
        # Powers of two, so that scaling rounds nothing; limits keep products of scales finite.
        limited_ranges = np.clip(ranges, 1e-50, 1e50)
        range_powers = np.log2(limited_ranges)
        both = 2.0 ** np.rint(range_powers)
        limited_level = np.clip(level, 1e-100, 1e100)
        cost_power = np.log2(limited_level)
        cost = 4.0 ** np.rint(cost_power / 2)
        return cls(
            state=both[:n],
            action=both[n:],
            cost=float(cost),
            ranges=ranges,
            level=level,
        )

    @property
    def both(self) -> Vector:
        """Scale of (x, u), (n+m,)."""
        return np.concatenate([self.state, self.action])

    @property
    def state_price(self) -> Vector:
        """Scale of multipliers of the states, cost/state, (n,)."""
        return np.asarray(self.cost / self.state)

    @property
    def action_price(self) -> Vector:
        """Scale of multipliers of the actions, cost/action, (m,)."""
        return np.asarray(self.cost / self.action)


def _cost_sizes(problem: Problem, both: Vector) -> dict[str, float]:
    """Sizes of the cost over steps `both` (n+m,) of (x, u), those that are not rounding, by name.

    They are `multiplier`, the largest of a state bound at the reference, `curvature`, the largest
    one, and `cost` itself; multipliers and curvatures of the economic cost. Raises ModelError where
    the multipliers cannot be computed.
    """
    n = problem.n_states
    lower = problem.lower
    upper = problem.upper
    reference = problem.reference
    gradient, curvature, rates = _derivatives_at_reference(problem)
    # A reference is written with a few digits: at a bound it may be beside it.
    near = ACTIVE_SHARE * (upper - lower)
    below = reference <= lower + near
    above = reference >= upper - near
    # Over a step of each variable, so that all sizes are costs.
    gradient_of_steps = gradient * both
    rates_of_steps = rates * both
    curvature_of_steps = np.abs(curvature * both**2)
    bound_multipliers = multipliers(gradient_of_steps, rates_of_steps, below, above)
    of_states = bound_multipliers[:n]
    # A second derivative that is not finite, as of a root at zero, says nothing of the size.
    finite_curvature = np.nan_to_num(curvature_of_steps, posinf=0.0)
    sizes = {
        "multiplier": float(of_states.max()),
        "curvature": float(finite_curvature.max()),
        "cost": abs(problem.reference_cost),
    }
    # A size below rounding counts as zero.
    rounding = np.finfo(np.float64).eps ** 0.5
    least = rounding * max(sizes.values())
    return {name: size for name, size in sizes.items() if size > least}


def linear_model(problem: Problem) -> tuple[Matrix, Matrix]:
    """A (n, n) and B (n, m) of the sampled nominal model at the problem's reference."""
    n = problem.n_states
    model = problem.model
    x, u, d, p = model.symbols()
    f = discretise(model, problem.sampling_time, problem.substeps)
    x_next = f(x, u, d, p)
    point = ca.vertcat(x, u)
    by_point = ca.jacobian(x_next, point)
    jacobian = ca.Function("AB", [x, u, d, p], [by_point])
    both = jacobian(*problem.nominal_point).full()
    A = both[:, :n]
    B = both[:, n:]
    return A, B


def _derivatives_at_reference(problem: Problem) -> tuple[Vector, Vector, Matrix]:
    """∇ℓ (n+m,), the diagonal of ∇²ℓ (n+m,), and ∂x' (n, n+m), by (x, u) at the reference."""
    model = problem.model
    symbols = model.symbols()
    x, u, _, _ = symbols
    w = ca.vertcat(x, u)
    cost = ca.SX(model.economic_cost(*symbols))
    hessian, gradient = ca.hessian(cost, w)
    diagonal = ca.diag(hessian)
    rate = model.ode(*symbols)
    jacobian = ca.jacobian(rate, w)
    function = ca.Function("d", list(symbols), [gradient, diagonal, jacobian])
    slope, curvature, by_point = function(*problem.nominal_point)
    # Columns of one entry a variable become vectors.
    return (
        slope.full().reshape(-1),
        curvature.full().reshape(-1),
        by_point.full(),
    )


def multipliers(
    gradient: Vector,
    rates: Vector,
    below: Mask,
    above: Mask,
) -> Vector:
    """|μ| of active bounds: least squares of ∇ℓ + (∂x')ᵀλ = μ, of the bounds' signs.

    They come from the QP min ½|w|² + ∇ℓᵀw under the equation ∂x' w = 0 and the active bounds.

    Args:
        gradient: ∇ℓ, (n+m,).
        rates: ∂x', (n, n+m).
        below: Whether w is at its lower bound, (n+m,).
        above: Whether w is at its upper bound, (n+m,).

    Returns:
        One a bound of (x, u), (n+m,); zero where it is not active.

    Raises:
        ModelError: DAQP finds none.
    """
    n_bounds = gradient.size
    size = np.abs(gradient).max()
    # Without a gradient nothing pushes; what is not finite is reported elsewhere.
    finite_gradient = np.isfinite(gradient).all()
    finite_rates = np.isfinite(rates).all()
    if not size or not finite_gradient or not finite_rates:
        return np.zeros(n_bounds)

    # An equation may be multiplied by any number: in rows of size 1 DAQP's tolerances mean what
    # they say.
    row_sizes = np.abs(rates).max(axis=1, keepdims=True)
    row_sizes = np.maximum(row_sizes, np.finfo(np.float64).tiny)
    rows = rates / row_sizes

    # DAQP's limits are those of the variables, then those of the rows, which are equations.
    n_equations = len(rates)
    zeros = np.zeros(n_equations)
    # Only a bound that the reference is at holds w back, and it does from there on.
    upper_of_w = np.where(above, 0.0, np.inf)
    lower_of_w = np.where(below, 0.0, -np.inf)
    upper = np.concatenate([upper_of_w, zeros])
    lower = np.concatenate([lower_of_w, zeros])
    sense = np.zeros(n_bounds + n_equations, dtype=np.int32)
    sense[n_bounds:] = DAQP_FIXED
    _, _, flag, info = daqp.solve(
        np.eye(n_bounds),
        gradient / size,
        rows,
        upper,
        lower,
        sense,
        **DAQP_SETTINGS,
    )
    if flag <= 0:
        raise ModelError(
            "problem: the multipliers of the bounds at the reference cannot be computed "
            f"({DAQP_STATUS.get(flag, flag)}); look at the derivatives of cost and model there"
        )
    bound_multipliers = np.abs(info["lam"][:n_bounds])
    # The gradient was given in units of its size.
    return np.asarray(bound_multipliers * size)


def _power(size: ArrayLike) -> Vector:
    """log10 of positive sizes, kept where products of the units are finite."""
    power = np.log10(size)
    return np.asarray(np.clip(power, -50.0, 50.0))


def _frozen(
    name: str,
    values: ArrayLike,
    size: int,
) -> Vector:
    """A copy that cannot be written to: a frozen problem stays as it was checked."""
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ModelError(f"problem: {name} holds no numbers: {values!r}") from error
    usable = array.shape == (size,) and np.isfinite(array).all()
    if not usable:
        raise ModelError(f"problem: {name} must be {size} finite numbers, not {array}")
    array.flags.writeable = False
    return array


VaryingKind = Literal["disturbance", "parameter", "price", "lower", "upper", "reference"]

MODEL_KINDS: tuple[VaryingKind, ...] = ("disturbance", "parameter", "price")
"""Kinds of what a signal gives of the model."""


class Varying(NamedTuple):
    """A quantity that differs from stage to stage.

    Attributes:
        signal: Name of the signal that gives its values.
        kind: What it is. A `price` is a parameter that the model's economic cost alone depends on.
        place: Its number among the model's disturbances, its parameters, the states, or (x, u).
        nominal: Its value where the signal is not known.
    """

    signal: str
    kind: VaryingKind
    place: int
    nominal: float


def varying_quantities(scenario: Scenario, model: Model) -> tuple[Varying, ...]:
    """Roles of a scenario's known signals in a controller's problem.

    Args:
        scenario: Has the signals, bounds and reference.
        model: The controller's model.

    Raises:
        ModelError: A signal names what the model does not have.
    """
    quantities = []
    for table in scenario.signals or ():
        # The plant follows such a signal, and the controller hears nothing of it.
        if table.known == "none":
            continue
        if table.model is not None:
            quantities.append(_of_model(table, table.model, model))
        elif table.bound is not None:
            quantities.append(_bound(table, scenario))
        elif table.reference is not None:
            quantities.append(_moving_reference(table, table.reference, scenario))
    return tuple(quantities)


def _of_model(
    table: SignalTable,
    name: str,
    model: Model,
) -> Varying:
    """The disturbance or parameter of a model that a signal is; raises ModelError."""
    # No two quantities of a model have one name.
    disturbances = [quantity.name for quantity in model.disturbances]
    parameters = [quantity.name for quantity in model.parameters]
    if name in disturbances:
        index = disturbances.index(name)
        nominal = model.disturbances[index].nominal
        return Varying(table.name, "disturbance", index, nominal)
    if name in parameters:
        index = parameters.index(name)
        kind: VaryingKind = "price" if is_price(model, index) else "parameter"
        nominal = model.parameters[index].nominal
        return Varying(table.name, kind, index, nominal)
    raise ModelError(
        f"signal '{table.name}': model '{model.name}' has no disturbance or parameter '{name}'"
        f"{instead(name, (*disturbances, *parameters))}"
    )


def _bound(table: SignalTable, scenario: Scenario) -> Varying:
    """The bound of a state that a signal is."""
    index = scenario.plant.states.index(table.bounded_state)
    kind: VaryingKind
    if table.is_lower_bound:
        kind = "lower"
        bounds = scenario.state_lower
    else:
        kind = "upper"
        bounds = scenario.state_upper
    nominal = float(bounds[index])
    return Varying(table.name, kind, index, nominal)


def _moving_reference(
    table: SignalTable,
    name: str,
    scenario: Scenario,
) -> Varying:
    """The reference of a state or an action that a signal is."""
    plant = scenario.plant
    names = [*plant.states, *plant.actions]
    index = names.index(name)
    references = np.concatenate([scenario.reference_state, scenario.reference_action])
    nominal = float(references[index])
    return Varying(table.name, "reference", index, nominal)


def is_price(model: Model, index: int) -> bool:
    """Whether a parameter is in the economic cost and not in the dynamics."""
    symbols = model.symbols()
    *_, p = symbols
    parameter = p[index]
    rates = ca.SX(model.ode(*symbols))
    cost = ca.SX(model.economic_cost(*symbols))
    in_dynamics = ca.depends_on(rates, parameter)
    in_cost = ca.depends_on(cost, parameter)
    return bool(in_cost and not in_dynamics)


def given_parameters(varying: Iterable[Varying], model: Model) -> tuple[str, ...]:
    """Names of a model's parameters whose values signals give, so that θ cannot have them.

    Args:
        varying: All quantities.
        model: The controller's model.
    """
    items = of_kind(varying, "parameter", "price")
    return tuple(model.parameters[item.place].name for _, item in items)


def of_kind(varying: Iterable[Varying], *kinds: VaryingKind) -> list[tuple[int, Varying]]:
    """The quantities of some kinds, each with its row among all.

    Args:
        varying: All quantities.
        kinds: The kinds that are wanted.
    """
    return [(row, item) for row, item in enumerate(varying) if item.kind in kinds]


def hold_last(column: Vector, values: Vector) -> None:
    """Fill the stages of the horizon with what is known of a signal; beyond that it keeps the last.

    Args:
        column: of the stages 0 … N, (N+1,), which is overwritten.
        values: the present one and those that follow, as many as are known.
    """
    n_known = min(len(values), len(column))
    column[:n_known] = values[:n_known]
    column[n_known:] = values[-1]


@dataclass(frozen=True)
class Problem:
    """A discounted optimal control problem around a reference steady state.

    The penalty of a violation v ≥ 0 is Σ_i linear_i v_i + quadratic_i v_i² (paper.tex,
    Simulations). Bounds and reference are in the units of the model's quantities.

    Args:
        model: The controller's model.
        sampling_time: Length of a sample in s.
        horizon: Number of stages N.
        discount: γ in (0, 1].
        state_lower: Lower bounds of the states, (n,).
        state_upper: Upper bounds of the states, (n,).
        action_lower: Lower bounds of the actions, (m,).
        action_upper: Upper bounds of the actions, (m,).
        penalty_linear: Linear weights of a violation, (n,).
        penalty_quadratic: Quadratic weights of a violation, (n,).
        reference_state: x_s, (n,).
        reference_action: u_s, (m,).
        reference_cost: ℓ_s.
        substeps: RK4 steps that make a sample of the model.
        varying: What differs from stage to stage of the horizon.

    Raises:
        ModelError: Sizes or values do not fit.

    Example:
        >>> problem = Problem.from_scenario(Scenario.load("paper"))
        >>> problem.horizon, problem.discount
        (10, 0.99)
        >>> problem.state_lower
        array([25., 40.])
    """

    model: Model
    sampling_time: float
    horizon: int
    discount: float
    state_lower: Vector
    state_upper: Vector
    action_lower: Vector
    action_upper: Vector
    penalty_linear: Vector
    penalty_quadratic: Vector
    reference_state: Vector
    reference_action: Vector
    reference_cost: float
    substeps: int = 2
    varying: tuple[Varying, ...] = ()

    def __post_init__(self) -> None:
        for name in VECTORS:
            size = self.n_actions if "action" in name else self.n_states
            given = getattr(self, name)
            vector = _frozen(name, given, size)
            object.__setattr__(self, name, vector)
        for kind in ("state", "action"):
            lower = getattr(self, f"{kind}_lower")
            upper = getattr(self, f"{kind}_upper")
            if not (lower < upper).all():
                raise ModelError(f"problem: {kind}_lower must be below {kind}_upper everywhere")
        # A slack without a price would be free, and one without curvature makes the QP degenerate.
        weights = np.concatenate([self.penalty_linear, self.penalty_quadratic])
        if (weights <= 0).any():
            raise ModelError("problem: penalty_linear and penalty_quadratic must be positive")
        if self.horizon < 1 or not 0 < self.discount <= 1:
            raise ModelError(
                f"problem: horizon {self.horizon} must be at least 1 and discount "
                f"{self.discount} in (0, 1]"
            )
        if not 0 < self.sampling_time < np.inf or self.substeps < 1:
            raise ModelError(
                f"problem: sampling_time {self.sampling_time} s must be positive and finite and "
                f"substeps {self.substeps} at least 1"
            )
        if not np.isfinite(self.reference_cost):
            raise ModelError(f"problem: reference_cost must be finite, not {self.reference_cost}")
        self._check_reference()

    def _check_reference(self) -> None:
        """Raise ModelError unless the model has finite values and derivatives at the reference."""
        model = self.model
        n = self.n_states
        symbols = model.symbols()
        x, u, _, _ = symbols
        point = ca.vertcat(x, u)
        results = []
        for function in (model.ode, model.economic_cost):
            value = ca.SX(function(*symbols))
            results.append(value)
            results.append(ca.jacobian(value, point))
        # Evaluated once: a value that is not finite would else appear in the first QP, far from its
        # cause.
        evaluate = ca.Function("at_reference", list(symbols), results)
        values = evaluate(*self.nominal_point)
        rate, rates, cost, slope = (value.full() for value in values)
        quantities = (*model.states, *model.actions)
        names = [quantity.name for quantity in quantities]
        # A value before its derivatives, which are not finite for the same reason.
        for i in range(n):
            what = f"ode(x, u, d, p): d/dt {names[i]}"
            self._require_finite(what, rate[i, 0])
        for i in range(n):
            for j, name in enumerate(names):
                what = f"ode(x, u, d, p): the derivative of d/dt {names[i]} by {name}"
                self._require_finite(what, rates[i, j])
        self._require_finite("economic_cost(x, u, d, p): the cost", cost[0, 0])
        for j, name in enumerate(names):
            what = f"economic_cost(x, u, d, p): the derivative of the cost by {name}"
            self._require_finite(what, slope[0, j])

    def _require_finite(self, what: str, value: float) -> None:
        """Raise ModelError where a value of the model at the reference is not finite."""
        if np.isfinite(value):
            return
        model = self.model
        quantities = (*model.states, *model.actions)
        point = []
        for quantity, entry in zip(quantities, self.reference, strict=True):
            point.append(f"{quantity.name} = {float(entry):g}")
        raise ModelError(
            f"model '{model.name}', {what} is {value} at the reference ({', '.join(point)}), "
            "where the controller linearises first; give another reference_state and "
            "reference_action, or a smooth expression"
        )

    @property
    def n_states(self) -> int:
        """Number of states n."""
        return len(self.model.states)

    @property
    def n_actions(self) -> int:
        """Number of actions m."""
        return len(self.model.actions)

    @property
    def reference(self) -> Vector:
        """Reference (x_s, u_s), shape (n+m,)."""
        return np.concatenate([self.reference_state, self.reference_action])

    @property
    def nominal_point(self) -> tuple[Vector, Vector, Vector, Vector]:
        """Arguments (x, u, d, p) of the model's functions at the reference, all nominal."""
        return (
            self.reference_state,
            self.reference_action,
            self.model.nominal_disturbance,
            self.model.nominal_parameters,
        )

    @property
    def lower(self) -> Vector:
        """Lower bounds of (x, u), shape (n+m,)."""
        return np.concatenate([self.state_lower, self.action_lower])

    @property
    def upper(self) -> Vector:
        """Upper bounds of (x, u), shape (n+m,)."""
        return np.concatenate([self.state_upper, self.action_upper])

    @cached_property
    def penalty(self) -> Penalty:
        """Penalty of a state by the true bounds."""
        return Penalty(
            self.state_lower,
            self.state_upper,
            self.penalty_linear,
            self.penalty_quadratic,
        )

    def symbolic_penalty(
        self,
        s: ca.SX,
        bounds: tuple[ca.SX, ca.SX] | None = None,
    ) -> ca.SX:
        """The penalty of the true bounds as a CasADi expression of a state (n,).

        Args:
            s: The state.
            bounds: Lower and upper bounds (n,) in the place of the problem's.
        """
        lower, upper = bounds or (self.state_lower, self.state_upper)
        # At most one of the two bounds is violated, so the larger excess is the violation.
        below = lower - s
        above = s - upper
        excess = ca.fmax(below, above)
        violation = ca.fmax(excess, 0)
        linear = ca.dot(self.penalty_linear, violation)
        quadratic = ca.dot(self.penalty_quadratic, violation**2)
        return linear + quadratic

    @cached_property
    def discounts(self) -> Vector:
        """γ⁰ … γᴺ, shape (N+1,).

        NumPy's power differs in the last bit between processors, and with it all that is keyed by
        the generated C; Python's is the C library's.
        """
        n_powers = self.horizon + 1
        powers = [self.discount**k for k in range(n_powers)]
        return np.array(powers)

    @cached_property
    def units(self) -> Units:
        """Orders of magnitude of states, actions and cost."""
        return Units.from_problem(self)

    @cached_property
    def scale(self) -> Scale:
        """Scales of the controller's QP."""
        return Scale.from_problem(self)

    @cached_property
    def content(self) -> str:
        """Digest of all that functions of this problem are made of: model, bounds, every number.

        Problems with the same content have the same functions. A model that calls what is outside
        of CasADi's own functions, such as a library in a file, has a content of its own: what it
        computes cannot be known.
        """
        model = self.model
        symbols = list(model.symbols())
        rates = ca.SX(model.ode(*symbols))
        cost = ca.SX(model.economic_cost(*symbols))
        function = ca.Function("content", symbols, [rates, cost])
        if not_in_c([function]) is not None:
            return secrets.token_hex()
        numbers = []
        for item in fields(self):
            if item.name in ("model", "varying"):
                continue
            value = np.asarray(getattr(self, item.name))
            numbers.append((item.name, value.tolist()))
        quantities = [getattr(model, kind) for kind in KINDS]
        facts = (model.name, quantities, model.time_unit, model.uncertain, numbers)
        text = repr(facts)
        if self.varying:
            text += repr(self.varying)
        text += function.serialize()
        digest = hashlib.sha256(text.encode())
        return digest.hexdigest()

    def value_level(self, discount: float | None = None) -> float:
        """ℓ_s/(1−γ), the value of staying at the reference; ℓ_s where γ = 1.

        `discount` γ is the problem's own where None.
        """
        gamma = self.discount if discount is None else discount
        # At γ = 1 the level of the value has no meaning; any finite one serves.
        if not gamma < 1:
            return self.reference_cost
        return self.reference_cost / (1 - gamma)

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> Problem:
        """Build the problem that a scenario describes; its model is named `module:factory`."""
        settings = scenario.controller
        model = load_model(settings.model)
        unbounded = []
        for name, low, high in zip(
            scenario.plant.states,
            scenario.state_lower,
            scenario.state_upper,
            strict=True,
        ):
            if not (isfinite(low) and isfinite(high)):
                unbounded.append(name)
        if unbounded:
            raise ModelError(
                f"scenario '{scenario.name}': bounds.state_lower and state_upper of "
                f"{', '.join(unbounded)} must be finite for this controller, which takes a scale "
                "from them; a bound that is never reached does no harm"
            )
        return cls(
            model=model,
            sampling_time=scenario.sampling_time,
            horizon=settings.horizon,
            discount=scenario.discount,
            state_lower=np.asarray(scenario.state_lower),
            state_upper=np.asarray(scenario.state_upper),
            action_lower=np.asarray(scenario.action_lower),
            action_upper=np.asarray(scenario.action_upper),
            penalty_linear=np.asarray(scenario.penalty_linear),
            penalty_quadratic=np.asarray(scenario.penalty_quadratic),
            reference_state=np.asarray(scenario.reference_state),
            reference_action=np.asarray(scenario.reference_action),
            reference_cost=settings.reference_cost,
            substeps=settings.substeps,
            varying=varying_quantities(scenario, model),
        )


def load_model(name: str | None) -> Model:
    """Import a model by `module:factory`; raises ModelError if that fails."""
    if name is None:
        raise ModelError(
            'the scenario names no model for this controller; add model = "module:factory" to its '
            'table [controller], for the evaporator "controllers.evaporator:model"'
        )
    # The module may be a user's: what it raises becomes one line.
    factory = load_plugin(name, f"model '{name}'", ModelError)
    try:
        model = factory()
    except ModelError as error:  # it has a model's own words
        raise ModelError(f"{name}: {error}") from error
    except (Exception, SystemExit) as error:  # a user's module may raise anything
        raise ModelError(f"model '{name}' cannot be made: {exception_line(error)}") from error
    if not isinstance(model, Model):
        raise ModelError(f"model '{name}' returned {type(model).__name__}, not a controllers.Model")
    return model


@dataclass(frozen=True)
class DisturbanceLaw:
    """Independent disturbances, drawn anew each sample and held over it.

    `uniform`: `nominal` ± `ranges`; `normal`: mean `nominal`, standard deviations `ranges`; `none`:
    always nominal. Both arrays have shape (n_d,).
    """

    kind: Literal["uniform", "normal", "none"]
    nominal: Vector
    ranges: Vector

    def draw(self, generator: np.random.Generator, count: int) -> Matrix:
        """Draw independent disturbances.

        Args:
            generator: What draws.
            count: How many are drawn.

        Returns:
            Disturbances in the model's units, (count, n_d).
        """
        size = (count, len(self.nominal))
        if self.kind == "none":
            return np.tile(self.nominal, (count, 1))
        if self.kind == "uniform":
            unit = generator.uniform(-1.0, 1.0, size)
        else:
            unit = generator.standard_normal(size)
        return self.nominal + self.ranges * unit


MEMORY_REACH = 5.0
"""Standard deviations of a filter's value to its bound; the optimum's grid goes a fifth beyond."""
NO_PENALTY = 1e-12
"""Weight of a violation of that bound: nothing, but a problem's weights are positive."""
NAME_THE_MODEL = 'name the plant\'s own model as model = "module:factory" in the table [plant]'


@dataclass(frozen=True)
class PlantProblem:
    """The problem with the plant's own model, its `law` and physical `parameters` (n_p,).

    Where a disturbance has a `memory`, the last state is its filter's value, and `law` that of its
    draws.
    """

    problem: Problem
    law: DisturbanceLaw
    parameters: Vector
    memory: Memory | None = None

    def with_memory(self, i: int, phi: float) -> PlantProblem:
        """The plant with a filter of disturbance i: its value is the last state, its draw d_i.

        Args:
            i: index of the disturbance, whose law is that of the draws.
            phi: φ of the filter, in (0, 1).
        """
        problem = self.problem
        law = self.law
        memory = Memory(i, problem.n_states, phi)
        nominal_value = float(law.nominal[i])
        spread = float(law.ranges[i])
        model = remember(problem.model, memory, nominal_value, spread)
        # The draw has no unit: the model gives the filter's value nominal value and range.
        nominal = law.nominal.copy()
        ranges = law.ranges.copy()
        nominal[i] = 0.0
        ranges[i] = 1.0
        # A uniform draw on [−1, 1] has the standard deviation 1/√3.
        reach = MEMORY_REACH / sqrt(3.0) if law.kind == "uniform" else MEMORY_REACH
        larger = replace(
            problem,
            model=model,
            state_lower=np.append(problem.state_lower, -reach),
            state_upper=np.append(problem.state_upper, reach),
            penalty_linear=np.append(problem.penalty_linear, NO_PENALTY),
            penalty_quadratic=np.append(problem.penalty_quadratic, NO_PENALTY),
            reference_state=np.append(problem.reference_state, 0.0),
        )
        law_of_draws = DisturbanceLaw(law.kind, nominal, ranges)
        return PlantProblem(larger, law_of_draws, self.parameters, memory)

    def sampled(self, substeps: int) -> ca.Function:
        """The state after a sample, a function (x, u, d, p), by so many RK4 steps."""
        problem = self.problem
        step = discretise(problem.model, problem.sampling_time, substeps)
        if self.memory is None:
            return step
        x, u, d, p = problem.model.symbols()
        next_x = step(x, u, d, p)
        # The model holds the filter's value within a sample, at whose end it changes.
        next_value = self.memory.next_value(x, d)
        next_x[self.memory.state] = next_value
        return ca.Function("sampled", [x, u, d, p], [next_x])

    @property
    def unseen(self) -> str:
        """Name of a disturbance whose memory the states do not tell; empty where there is none.

        Where nothing else varies, two states in a row tell what the disturbance was.
        """
        if self.memory is None:
            return ""
        i = self.memory.disturbance
        others = np.delete(self.law.ranges, i)
        if not others.any():
            return ""
        return self.problem.model.disturbances[i].name

    @classmethod
    def from_scenario(cls, scenario: Scenario) -> PlantProblem:
        """The problem of a scenario.

        The plant's model is `plant.model`, else the controller's. Raises OptimumError where it does
        not fit the plant, or the state that it has is not the whole state, ModelError where it
        cannot be loaded.
        """
        if scenario.signals:
            raise OptimumError(
                f"scenario '{scenario.name}' has signals, and this optimum is of a plant where "
                "nothing moves with time: take controllers.periodic_optimum"
            )
        filtered = _filtered(scenario)
        _require_whole_state(scenario, filtered)
        problem = Problem.from_scenario(scenario)
        plant = scenario.plant
        table = scenario.disturbance
        if plant.model is not None:
            problem = replace(problem, model=load_model(plant.model))
        model = problem.model
        # The optimum is that of the plant only if both mean the same, in the same order.
        needed = "the optimum needs a model of the plant"
        for kind in ("states", "actions", "disturbances"):
            ours = [quantity.name for quantity in getattr(model, kind)]
            theirs = list(getattr(plant, kind))
            if ours != theirs:
                raise OptimumError(
                    f"{needed}: model '{model.name}' has the {kind} {', '.join(ours)}, the plant "
                    f"{', '.join(theirs)}; {NAME_THE_MODEL}"
                )
        # What the scenario does not say is the model's: its nominal disturbances, without noise.
        nominal = model.nominal_disturbance
        if len(table.nominal):
            nominal = np.array(table.nominal)
        ranges = np.zeros(len(nominal))
        if len(table.ranges):
            ranges = np.array(table.ranges)
        law = DisturbanceLaw(table.law, nominal, ranges)

        # The plant's parameters are the model's nominal ones, where the scenario does not set them.
        parameters = {quantity.name: quantity.nominal for quantity in model.parameters}
        for name, value in plant.parameters.items():
            if name not in parameters:
                raise OptimumError(
                    f"{needed}: plant.parameters sets '{name}', which model '{model.name}' does "
                    f"not have: give the model that parameter, {NAME_THE_MODEL}, or, where it only "
                    "shapes the noise, name it in plant.mapping.ranges and set disturbance.ranges"
                )
            parameters[name] = value
        in_order = list(parameters.values())
        values = np.array(in_order, dtype=np.float64)
        white = cls(problem, law, values)
        # One at most: `_require_whole_state` refuses more.
        for name, constant in filtered.items():
            index = plant.disturbances.index(name)
            phi = exp(-problem.sampling_time / constant)
            return white.with_memory(index, phi)
        return white


def _fmu_file(scenario: Scenario) -> Path:
    """Path of the plant's FMU."""
    fmu = scenario.plant.fmu
    shipped = (*fmus.NAMES, *fmus.PLANTS)
    if fmu in shipped:
        return fmus.path(fmu)
    return Path(fmu)


def _filtered(scenario: Scenario) -> dict[str, float]:
    """Time constants in s of the disturbances that vary and have a memory, by name."""
    plant = scenario.plant
    table = scenario.disturbance
    stated = table.time_constant or ()
    constants = dict(zip(plant.disturbances, stated, strict=False))
    # What no scenario sets is as the FMU has it.
    if not plant.mapping.time_constant:
        constants |= time_constants(_fmu_file(scenario))
    ranges = dict(zip(plant.disturbances, table.ranges, strict=False))
    filtered = {}
    for name, constant in constants.items():
        varies = table.law != "none" and ranges.get(name, 1.0) > 0.0
        if varies and constant > 0.0:
            filtered[name] = constant
    return filtered


def _require_whole_state(scenario: Scenario, filtered: Mapping[str, float]) -> None:
    """Raise OptimumError where the plant has states that the optimum cannot have.

    Args:
        scenario: of the plant.
        filtered: the disturbances with a memory.
    """
    plant = scenario.plant
    if len(filtered) > 1:
        raise OptimumError(
            "the optimum is computed for one disturbance with a memory, and "
            f"{', '.join(filtered)} have one by disturbance.time_constant; compare with the best θ "
            "of a search on the plant"
        )
    # Whoever names the plant's own model says that its states are all that matter.
    if plant.model is not None:
        return
    fmu = _fmu_file(scenario)
    # Of an array the scenario names an element, as level[1].
    named = {name.partition("[")[0] for name in plant.states}
    hidden = [name for name in continuous_states(fmu) if name not in named]
    if hidden:
        raise OptimumError(
            f"there is no J* of this scenario: FMU '{fmu.name}' has the states "
            f"{', '.join(hidden)}, and plant.states does not name them; compare with the best θ of "
            "a search on the plant"
        )


P = ParamSpec("P")
Built = TypeVar("Built")

KEPT = 32
"""Results that a function keeps: those of the problems that were used last."""


@dataclass(frozen=True)
class _Call:
    """A call of the function: equal to another one where content and arguments are equal."""

    content: str
    arguments: tuple[object, ...]
    options: tuple[tuple[str, object], ...]
    problem: Problem = field(compare=False)


def built_once(
    build: Callable[Concatenate[Problem, P], Built],
) -> Callable[Concatenate[Problem, P], Built]:
    """Keep what a function of a problem builds, for problems of the same `Problem.content`.

    A training, an evaluation and a study make many controllers of one problem, and CasADi's graphs
    take most of the time to make one. What is kept is shared, so it must never change.

    Args:
        build: Function of a problem and of other hashable arguments. Its result depends on nothing
            else.
    """

    @lru_cache(maxsize=KEPT)
    def kept(call: _Call) -> Built:
        options = dict(call.options)
        return build(call.problem, *call.arguments, **options)  # type: ignore[arg-type]

    @wraps(build)
    def find(
        problem: Problem,
        /,
        *arguments: P.args,
        **options: P.kwargs,
    ) -> Built:
        # A dictionary has no hash, which the cache looks a call up by.
        hashable_options = tuple(options.items())
        call = _Call(problem.content, arguments, hashable_options, problem)
        return kept(call)

    return find
