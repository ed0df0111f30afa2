"""The parameters θ: named blocks in one flat vector, their values and file, and their symbols.

The values σ of the problem's varying quantities at the stages 0 … N stand behind θ's symbols:
(θ, σ_0, …, σ_N), in the place that θ alone has where nothing varies. So what computes from θ
computes from the signals too, and a problem without any has the same functions as ever. A function
of one stage has (θ, σ_k, γᵏ) there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Annotated, Any

import casadi as ca
import numpy as np
import tomli_w
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from controllers.errors import ModelError, ParameterError
from controllers.functions import Expression, consecutive
from controllers.model import Model
from controllers.problem import Problem, VaryingKind, of_kind
from cosim.core.files import parse_toml, read_text, write_atomically
from cosim.core.protocols import Vector
from cosim.core.result import Shown
from cosim.core.scenario import Names, Table
from cosim.core.validation import SchemaVersion, instead, validated


# Kept: NumPy makes the indices out of a mask of the whole matrix, each time.
@cache
def upper_triangle(dimension: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of a matrix's upper triangle, row by row: the order of packed entries."""
    rows, columns = np.triu_indices(dimension)
    return rows, columns


def symmetric_matrix(packed: Vector, dimension: int) -> Vector:
    """Symmetric matrix from the packed entries of its upper triangle.

    Args:
        packed: The entries row by row, (d(d+1)/2,).
        dimension: Number of rows d.

    Returns:
        The matrix, (d, d).
    """
    matrix = np.empty((dimension, dimension))
    rows, columns = upper_triangle(dimension)
    matrix[rows, columns] = packed
    matrix[columns, rows] = packed
    return matrix


@dataclass(frozen=True)
class ThetaBlock:
    """A named part of θ, by its `shape` a scalar (), a vector (d,) or a symmetric matrix (d, d).

    A symmetric matrix is packed as its upper triangle row by row. `scale` is the typical size of a
    change, by packed entry in the block's own units, `meaning` a few words, `labels` the entries'
    own names, `least` their smallest values, where there are such.
    """

    name: str
    shape: tuple[int, ...]
    scale: tuple[float, ...]
    meaning: str = ""
    labels: tuple[str, ...] = ()
    least: tuple[float, ...] = ()

    @property
    def size(self) -> int:
        """Number of entries in θ."""
        return len(self.scale)

    @property
    def symmetric(self) -> bool:
        """Whether the block is a symmetric matrix."""
        return len(self.shape) == 2

    def pack(self, value: ArrayLike) -> Vector:
        """Flatten an unpacked value; raises ParameterError on a wrong shape or asymmetry."""
        try:
            # NumPy makes objects of ragged lists, or raises, by its version; both are refused.
            array = np.asarray(value)
        except ValueError:  # ragged nesting
            array = np.array(None)
        if array.dtype.kind not in "iuf":
            raise ParameterError(f"θ block {self.name} holds no float64 numbers: {value!s:.80}")
        array = array.astype(np.float64)
        if array.shape != self.shape:
            raise ParameterError(
                f"θ block {self.name} has shape {array.shape}; it must have {self.shape}"
            )
        if not self.symmetric:
            return array.reshape(-1)
        # A NaN is reported by its label, when the whole of θ is known.
        if not np.array_equal(array, array.T, equal_nan=True):
            raise ParameterError(f"θ block {self.name} must be symmetric: {array.tolist()}")
        return array[upper_triangle(len(array))]

    def unpack(self, packed: Vector) -> Vector:
        """Value of the block in its own shape from its packed entries."""
        if self.symmetric:
            dimension = self.shape[0]
            return symmetric_matrix(packed, dimension)
        # A copy: θ itself is shared, and read-only.
        return packed.reshape(self.shape).copy()


@dataclass(frozen=True)
class ThetaBlocks:
    """The blocks of θ, in order."""

    blocks: tuple[ThetaBlock, ...]

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Slice of each block in θ."""
        sizes = {block.name: block.size for block in self.blocks}
        return consecutive(sizes)

    @cached_property
    def size(self) -> int:
        """Length of θ."""
        return sum(block.size for block in self.blocks)

    @cached_property
    def scale(self) -> Vector:
        """Learning scale of each entry of θ."""
        scales = [np.array(block.scale) for block in self.blocks]
        return np.concatenate(scales)

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """A name for each entry of θ, such as `B_l[0,2]`."""
        names: list[str] = []
        for block in self.blocks:
            if not block.shape:
                names.append(block.name)
                continue
            entries: Iterable[object] = block.labels or range(block.size)
            if block.symmetric:
                # In the order of the packed entries.
                rows, columns = upper_triangle(block.shape[0])
                pairs = zip(rows, columns, strict=True)
                entries = [f"{i},{j}" for i, j in pairs]
            for entry in entries:
                names.append(f"{block.name}[{entry}]")
        return tuple(names)

    def __iter__(self) -> Iterator[ThetaBlock]:
        return iter(self.blocks)

    def __contains__(self, name: str) -> bool:
        return name in self.slices

    def block(self, name: str) -> ThetaBlock:
        """Block of this name; raises ParameterError if it does not exist."""
        for block in self.blocks:
            if block.name == name:
                return block
        raise ParameterError(f"θ has no block '{name}'{instead(name, self.slices)}")

    @classmethod
    def from_problem(
        cls,
        problem: Problem,
        *,
        slack_weights: bool = False,
        model_parameters: tuple[str, ...] = (),
        margin: bool = False,
        noise: tuple[str, ...] = (),
    ) -> ThetaBlocks:
        """Blocks of the paper's θ for a problem (paper.tex, Simulations), and optional ones.

        Scales are made of the problem's `Units` ρ and κ: a Hessian's is κ/ρ_iρ_j, a gradient's
        0.1 κ/ρ, a bound's ρ/100, those of the slack weights κ/ρ and 1000 κ/ρ².

        Args:
            problem: The control problem.
            slack_weights: Whether to add the linear and quadratic slack weights w_sigma and W_sigma
                of the predicted stages 1…N.
            model_parameters: Physical parameters of the model that are to be a block p, by name.
            margin: Whether to add a block `margin` (`OutputFeedback`).
            noise: What the variances of a block `noise` are of (`ExtendedKalmanFilter`).

        Raises:
            ModelError: The model has no such parameter.
        """
        units = problem.units
        kappa = units.cost
        states = units.state
        both = np.concatenate([states, units.action])
        # Curvatures that make a cost of κ over a unit of each variable, slopes a tenth of it.
        state_hessian = kappa / np.outer(states, states)
        state_gradient = 0.1 * kappa / states
        hessian = kappa / np.outer(both, both)
        gradient = 0.1 * kappa / both
        constant = np.array(0.1 * kappa)
        bound = 0.01 * states
        blocks = [
            _block("B_lambda", state_hessian, "initial cost, quadratic"),
            _block("b_lambda", state_gradient, "initial cost, linear"),
            _block("c_lambda", constant, "initial cost, constant"),
            _block("B_Vf", state_hessian, "terminal cost, quadratic"),
            _block("b_Vf", state_gradient, "terminal cost, linear"),
            _block("B_l", hessian, "stage cost, quadratic"),
            _block("b_l", gradient, "stage cost, linear"),
            _block("c_f", 0.001 * states, "model offset"),
            _block("x_l", bound, "lower state bound"),
            _block("x_u", bound, "upper state bound"),
        ]
        if slack_weights:
            # Below its least weights a penalty is not exact: the QP would rather violate a bound.
            quadratic = kappa / states**2
            blocks += [
                _block(
                    "w_sigma",
                    kappa / states,
                    "slack of stages 1…N, linear weight",
                    units.exact_penalty_weights(),
                ),
                _block(
                    "W_sigma",
                    1e3 * quadratic,
                    "slack of stages 1…N, quadratic weight",
                    quadratic,
                ),
            ]
        if model_parameters:
            model = problem.model
            indices = model.parameter_indices(model_parameters)
            scale = [0.1 * abs(model.parameters[i].nominal) for i in indices]
            parameters = ThetaBlock(
                name="p",
                shape=(len(indices),),
                scale=tuple(scale),
                meaning="model parameters",
                labels=model_parameters,
            )
            blocks.append(parameters)
        if margin:
            blocks.append(margin_block(problem))
        if noise:
            blocks.append(noise_block(noise))
        return cls(tuple(blocks))


def noise_block(labels: tuple[str, ...]) -> ThetaBlock:
    """The block `noise`: logarithms of variances, so that a change of 1 is a factor of e.

    Args:
        labels: What the variances are of.
    """
    return ThetaBlock(
        name="noise",
        shape=(len(labels),),
        scale=(1.0,) * len(labels),
        meaning="log variances of the estimator",
        labels=labels,
    )


def margin_block(problem: Problem) -> ThetaBlock:
    """The block `margin`, (2n,): how many deviations of the estimate each bound is tightened by.

    Args:
        problem: Has the states, whose lower bounds come first.
    """
    names = [quantity.name for quantity in problem.model.states]
    labels = []
    for side in ("lower", "upper"):
        labels += [f"{side} {name}" for name in names]
    return ThetaBlock(
        name="margin",
        shape=(len(labels),),
        scale=(1.0,) * len(labels),
        meaning="deviations of the estimate by which a bound is tightened",
        labels=tuple(labels),
    )


def add_margin(parameters: Parameters, problem: Problem) -> Parameters:
    """θ with a block `margin` of zeros before `noise`; θ itself where it has one.

    Args:
        parameters: θ.
        problem: Its problem.
    """
    if "margin" in parameters.blocks:
        return parameters
    others = list(parameters.blocks)
    place = len(others) - ("noise" in parameters.blocks)
    others.insert(place, margin_block(problem))
    blocks = ThetaBlocks(tuple(others))
    zero = Parameters(blocks, np.zeros(blocks.size))
    return parameters.placed_in(zero)


def _block(
    name: str,
    scale: Vector,
    meaning: str,
    least: ArrayLike = (),
) -> ThetaBlock:
    """A block of the shape of its scale, which is a scalar, a vector or a symmetric matrix."""
    # Packed as θ has it.
    packed = scale.reshape(-1)
    if scale.ndim == 2:
        packed = scale[upper_triangle(len(scale))]
    return ThetaBlock(
        name,
        scale.shape,
        tuple(packed.tolist()),
        meaning,
        least=tuple(np.asarray(least).tolist()),
    )


class _File(Table):
    schema_version: Annotated[SchemaVersion, Field(alias="schema")]
    hash: str | None = None
    theta: dict[str, Any]
    model_parameters: Names = ()
    noise: Names = ()


@dataclass(frozen=True, repr=False)
class Parameters(Shown):
    """A value `theta` of θ, (blocks.size,), with its blocks; `parameters["B_l"]` is a whole block.

    Raises ParameterError on a vector of wrong length or with an entry that is not finite.

    Example:
        >>> problem = Problem.from_scenario(Scenario.load("paper"))
        >>> parameters = Parameters.naive(problem)
        >>> parameters.replace({"x_l": [25.1, 41.0]})["x_l"]
        array([25.1, 41. ])
    """

    blocks: ThetaBlocks
    theta: Vector

    def __post_init__(self) -> None:
        theta = np.array(self.theta, dtype=np.float64)
        if theta.shape != (self.blocks.size,):
            raise ParameterError(f"θ has shape {theta.shape}; it must have ({self.blocks.size},)")
        finite = np.isfinite(theta)
        if not finite.all():
            # The first entry is named: a message with all of θ helps nobody.
            first = int(np.flatnonzero(~finite)[0])
            raise ParameterError(f"θ is not finite at {self.blocks.labels[first]}")
        # θ is shared by controllers and logs: who changes it makes a new one.
        theta.flags.writeable = False
        object.__setattr__(self, "theta", theta)

    def __getitem__(self, name: str) -> Vector:
        block = self.blocks.block(name)
        packed = self.theta[self.blocks.slices[name]]
        return block.unpack(packed)

    def _facts(self) -> dict[str, object]:
        return {
            "hash": self.hash,
            "blocks": ", ".join(self.blocks.slices),
            "size": len(self.theta),
        }

    def to_pandas(self) -> Any:
        """The entries of θ by their labels, with their learning scales, as a pandas data frame."""
        import pandas as pd  # noqa: PLC0415 - half a second

        columns = {"theta": self.theta, "scale": self.blocks.scale}
        labels = list(self.blocks.labels)
        return pd.DataFrame(columns, index=labels)

    def replace(self, blocks: Mapping[str, ArrayLike]) -> Parameters:
        """Copy with the named blocks set to new values."""
        theta = self.theta.copy()
        for name, value in blocks.items():
            packed = self.blocks.block(name).pack(value)
            theta[self.blocks.slices[name]] = packed
        return Parameters(self.blocks, theta)

    def placed_in(self, other: Parameters) -> Parameters:
        """`other`, which has this θ's blocks, with this θ's values; a longer p keeps its end."""
        values = {block.name: self[block.name] for block in self.blocks}
        if "p" in values:
            # Estimated disturbances are the last entries of p.
            p = values["p"]
            end = other["p"][p.size :]
            values["p"] = np.concatenate([p, end])
        return other.replace(values)

    def with_theta(self, theta: ArrayLike) -> Parameters:
        """Copy with another flat vector."""
        return Parameters(self.blocks, np.asarray(theta, dtype=np.float64))

    def of_model(self, model: Model) -> Vector:
        """All parameters of a model at θ, (n_p,): the nominal ones but for θ's block p."""
        values = model.nominal_parameters
        if "p" in self.blocks:
            names = self.blocks.block("p").labels
            indices = model.parameter_indices(names)
            values[indices] = self["p"]
        return values

    def require_well_posed(self) -> None:
        """Raise ParameterError on an x_l not below its x_u or a slack weight not positive."""
        lower = self["x_l"]
        upper = self["x_u"]
        # A QP of such bounds would fail in a sample, far from whoever has set θ.
        if not (lower < upper).all():
            raise ParameterError(f"θ: x_l = {lower} must stay below x_u = {upper}")
        for name in ("w_sigma", "W_sigma"):
            if name not in self.blocks:
                continue
            weights = self[name]
            if not (weights > 0).all():
                raise ParameterError(f"θ: {name} = {weights} must be positive")

    @property
    def hash(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of names and exact values."""
        # Hexadecimal, so that the hash is of the exact values and not of their rounding to
        # decimals.
        values = [float(value).hex() for value in self.theta]
        names = list(self.blocks.labels)
        content = json.dumps([names, values])
        digest = hashlib.sha256(content.encode())
        return digest.hexdigest()[:16]

    @classmethod
    def naive(cls, problem: Problem, blocks: ThetaBlocks | None = None) -> Parameters:
        """The paper's naive guess: B_l = I, B_Vf = I, c_lambda = ℓ_s, true bounds, else 0.

        Slack weights in θ start at the true penalty, model parameters at their nominal values.

        Args:
            problem: The control problem.
            blocks: The blocks of θ; the paper's where they are None.
        """
        blocks = blocks or ThetaBlocks.from_problem(problem)
        values: dict[str, ArrayLike] = {
            "B_l": np.eye(problem.n_states + problem.n_actions),
            "B_Vf": np.eye(problem.n_states),
            "c_lambda": problem.reference_cost,
            "x_l": problem.state_lower,
            "x_u": problem.state_upper,
        }
        if "w_sigma" in blocks:
            values["w_sigma"] = problem.penalty_linear
            values["W_sigma"] = problem.penalty_quadratic
        if "p" in blocks:
            names = blocks.block("p").labels
            chosen = problem.model.parameter_indices(names)
            values["p"] = problem.model.nominal_parameters[chosen]
        # No rotation of the value, no linear cost, no model offset: all other blocks are zero.
        zero = cls(blocks, np.zeros(blocks.size))
        return zero.replace(values)

    def to_toml(self) -> str:
        """θ as TOML with schema version and hash."""
        values = {}
        for block in self.blocks:
            values[block.name] = self[block.name].tolist()
        document: dict[str, Any] = {
            "schema": 1,
            "hash": self.hash,
            "theta": values,
        }
        # Whoever reads the file has the problem alone: these blocks say what they are of.
        if "p" in self.blocks:
            names = self.blocks.block("p").labels
            document["model_parameters"] = list(names)
        if "noise" in self.blocks:
            labels = self.blocks.block("noise").labels
            document["noise"] = list(labels)
        return tomli_w.dumps(document)

    def save(self, path: str | Path) -> Path:
        """Write `to_toml` to a file, which appears whole or not at all."""
        return write_atomically(path, self.to_toml())

    @classmethod
    def load(cls, path: str | Path, problem: Problem) -> Parameters:
        """Read θ from a file, which says which optional blocks it has.

        Args:
            path: The θ file.
            problem: The control problem.

        Raises:
            ParameterError: The file is missing or no TOML, has another schema, key or block, or
                values that do not match its hash.
        """
        text = read_text(path, f"parameters file '{path}'", ParameterError)
        return cls.from_toml(text, problem, path)

    @classmethod
    def from_toml(
        cls,
        text: str,
        problem: Problem,
        path: str | Path,
    ) -> Parameters:
        """Read θ from a file's text, as `load` does.

        Args:
            text: Text of the θ file.
            problem: The control problem.
            path: What the file is called in messages.
        """
        origin = f"parameters file '{path}'"
        document = parse_toml(text, origin, ParameterError)
        file = validated(_File, document, origin, ParameterError)
        values = file.theta
        # The file's keys say which optional blocks it has, so that it can be read without flags.
        slack_weights = "w_sigma" in values or "W_sigma" in values
        margin = "margin" in values
        try:
            blocks = ThetaBlocks.from_problem(
                problem,
                slack_weights=slack_weights,
                model_parameters=file.model_parameters,
                margin=margin,
                noise=file.noise,
            )
            missing = [name for name in blocks.slices if name not in values]
            unknown = [name for name in values if name not in blocks]
            if missing or unknown:
                raise ParameterError(
                    f"θ blocks missing: {', '.join(missing) or 'none'}; "
                    f"not known: {', '.join(unknown) or 'none'}"
                )
            zero = cls(blocks, np.zeros(blocks.size))
            parameters = zero.replace(values)
        except (ModelError, ParameterError) as error:
            raise ParameterError(f"{path}: {error}") from error
        # An edit by hand is caught, unless it is said to be meant.
        if file.hash not in (None, parameters.hash):
            raise ParameterError(
                f"{path}: the values have hash {parameters.hash}, the file says "
                f"{file.hash}; delete its line `hash` if the values were edited on purpose"
            )
        return parameters


Symbols = dict[str, ca.SX]


def symbolic_theta(
    problem: Problem,
    blocks: ThetaBlocks,
    behind: int = 0,
) -> Symbols:
    """Symbol `theta` (n_θ,), its blocks by name, and `model_parameters` (n_p,) with θ's own in it.

    A slack weight that is no block is the problem's constant.

    Args:
        problem: The control problem.
        blocks: The blocks of θ.
        behind: Entries that `theta` has behind θ's own.
    """
    theta = ca.SX.sym("theta", blocks.size + behind)
    symbols = {"theta": theta}
    for block in blocks:
        part = theta[blocks.slices[block.name]]
        if block.symmetric:
            # Where each of the matrix's entries is among the packed ones.
            numbers = np.arange(float(block.size))
            places = block.unpack(numbers).astype(int)
            in_sequence = places.reshape(-1).tolist()
            entries = part[in_sequence]
            # CasADi fills columns, NumPy read rows: of a symmetric matrix both are the same.
            part = ca.reshape(entries, *block.shape)
        symbols[block.name] = part

    # So that what reads the weights need not ask whether they are learned.
    if "w_sigma" not in blocks:
        linear = ca.DM(problem.penalty_linear)
        quadratic = ca.DM(problem.penalty_quadratic)
        symbols["w_sigma"] = ca.SX(linear)
        symbols["W_sigma"] = ca.SX(quadratic)

    # Parameters that θ does not hold stay at their nominal values.
    model = problem.model
    parameters = ca.SX(ca.DM(model.nominal_parameters))
    if "p" in blocks:
        names = blocks.block("p").labels
        indices = model.parameter_indices(names)
        for i, index in enumerate(indices):
            parameters[index] = symbols["p"][i]
    symbols["model_parameters"] = parameters
    return symbols


def given_size(problem: Problem, blocks: ThetaBlocks) -> int:
    """Entries of (θ, σ).

    Args:
        problem: The problem.
        blocks: The blocks of θ.
    """
    n_stages = problem.horizon + 1
    return blocks.size + len(problem.varying) * n_stages


def nominal_given(problem: Problem, theta: Vector) -> Vector:
    """(θ, σ) with every varying quantity at its nominal value.

    Args:
        problem: The problem.
        theta: θ, (n_θ,).
    """
    nominal = [item.nominal for item in problem.varying]
    n_stages = problem.horizon + 1
    sigma = np.tile(nominal, n_stages)
    return np.concatenate([theta, sigma])


def symbolic_given(problem: Problem, blocks: ThetaBlocks) -> Symbols:
    """`symbolic_theta` whose `theta` is (θ, σ), and `sigma` (n_σ, N+1)."""
    count = len(problem.varying)
    n_stages = problem.horizon + 1
    symbols = symbolic_theta(problem, blocks, count * n_stages)
    behind = symbols["theta"][blocks.size :]
    # A stage in each column, as CasADi stacks them.
    symbols["sigma"] = ca.reshape(behind, count, n_stages)
    return symbols


def given_parts(problem: Problem, blocks: ThetaBlocks, given: ca.MX) -> dict[str, ca.MX]:
    """Parts of (θ, σ) for a graph of calls: θ's blocks, packed as θ has them, and `sigma`.

    A slack weight that is no block is the problem's constant, `sigma` is (n_σ, N+1).

    Args:
        problem: The problem.
        blocks: The blocks of θ.
        given: (θ, σ).
    """
    parts = {name: given[place] for name, place in blocks.slices.items()}
    parts.setdefault("w_sigma", ca.MX(ca.DM(problem.penalty_linear)))
    parts.setdefault("W_sigma", ca.MX(ca.DM(problem.penalty_quadratic)))
    behind = given[blocks.size :]
    parts["sigma"] = ca.reshape(behind, len(problem.varying), problem.horizon + 1)
    return parts


def symbolic_stage(problem: Problem, blocks: ThetaBlocks) -> Symbols:
    """`symbolic_theta` whose `theta` is (θ, σ_k, γᵏ), and what the model is given at the stage.

    That are `disturbance` (n_d,), `model_parameters` (n_p,), and `nominal_prices`, the same with
    each price at its nominal value; and `discount`, γᵏ.

    Raises:
        ModelError: A varying parameter is one of θ's.
    """
    varying = problem.varying
    model = problem.model
    # Behind θ the signals and γᵏ, which differs from stage to stage where they do.
    n_behind = len(varying) + 1 if varying else 0
    symbols = symbolic_theta(problem, blocks, n_behind)
    theta = symbols["theta"]
    disturbance = ca.SX(ca.DM(model.nominal_disturbance))
    parameters = symbols["model_parameters"]
    # θ's cost stands for the nominal prices: what a price adds is the difference from these.
    nominal_prices = ca.SX(parameters)
    in_theta: tuple[str, ...] = ()
    if "p" in blocks:
        in_theta = blocks.block("p").labels
    for row, item in of_kind(varying, "disturbance", "parameter", "price"):
        value = theta[blocks.size + row]
        if item.kind == "disturbance":
            disturbance[item.place] = value
            continue
        name = model.parameters[item.place].name
        if name in in_theta:
            raise ModelError(
                f"signal '{item.signal}' gives the model's parameter {name}, which is in θ too: "
                "one of both can say what it is"
            )
        parameters[item.place] = value
        if item.kind != "price":
            nominal_prices[item.place] = value
    symbols["disturbance"] = disturbance
    symbols["nominal_prices"] = nominal_prices
    symbols["discount"] = theta[-1] if varying else ca.SX(1.0)
    return symbols


def stage_columns(
    problem: Problem,
    blocks: ThetaBlocks,
    given: ca.MX,
) -> ca.MX:
    """Inputs of the functions of the stages 0 … N−1 in place of θ, side by side.

    Args:
        problem: The problem.
        blocks: The blocks of θ.
        given: (θ, σ).
    """
    horizon = problem.horizon
    count = len(problem.varying)
    if not count:
        return ca.repmat(given, 1, horizon)
    begins = [0, blocks.size, given.numel()]
    theta, behind = ca.vertsplit(given, begins)
    theta_of_stages = ca.repmat(theta, 1, horizon)
    # The last column and the last power are those of x_N, where the horizon ends.
    sigma = ca.reshape(behind, count, horizon + 1)
    sigma_of_stages = sigma[:, :-1]
    discounts = ca.DM(problem.discounts[:-1])
    row_of_discounts = ca.MX(discounts.T)
    return ca.vertcat(theta_of_stages, sigma_of_stages, row_of_discounts)


def state_bounds(
    problem: Problem,
    symbols: Mapping[str, Expression],
) -> tuple[list[Expression], list[Expression]]:
    """θ's lower and upper bounds of the states at the stages 0 … N, (n,) each.

    A bound that moves is θ's, moved by as much as the signal is off the scenario's bound: what θ
    keeps from it is kept.

    Args:
        problem: The problem.
        symbols: Of `symbolic_given` or `given_parts`.
    """
    sigma = symbols["sigma"]
    lower = _moved(problem, sigma, "lower", symbols["x_l"])
    upper = _moved(problem, sigma, "upper", symbols["x_u"])
    return lower, upper


def true_bounds(problem: Problem, symbols: Symbols) -> tuple[ca.SX, ca.SX] | None:
    """The scenario's bounds of the present state as they are known, (n,) each; None if none moves.

    Args:
        problem: The problem.
        symbols: Of `symbolic_given`.
    """
    if not of_kind(problem.varying, "lower", "upper"):
        return None
    sigma = symbols["sigma"]
    lower = _moved(problem, sigma, "lower", ca.SX(ca.DM(problem.state_lower)))
    upper = _moved(problem, sigma, "upper", ca.SX(ca.DM(problem.state_upper)))
    return lower[0], upper[0]


def moved_references(problem: Problem, sigma: Expression) -> list[Expression]:
    """Distance of the cost's reference from the problem's at the stages 0 … N, (n+m,) each.

    Args:
        problem: The problem.
        sigma: Values of the varying quantities, (n_σ, N+1).
    """
    still = type(sigma).zeros(problem.n_states + problem.n_actions)
    return _moved(problem, sigma, "reference", still)


def _moved(
    problem: Problem,
    sigma: Expression,
    kind: VaryingKind,
    start: Expression,
) -> list[Expression]:
    """A vector at the stages 0 … N, moved by the varying quantities of a kind."""
    moving = of_kind(problem.varying, kind)
    n_stages = problem.horizon + 1
    if not moving:
        # One expression for all of them: what is made of it is computed once.
        return [start] * n_stages
    stages = []
    for k in range(n_stages):
        vector = type(start)(start)
        for row, item in moving:
            vector[item.place] += sigma[row, k] - item.nominal
        stages.append(vector)
    return stages
