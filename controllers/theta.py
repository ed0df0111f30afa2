"""θ in one flat vector: named blocks, symmetric packing, learning scales."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.errors import ParameterError
from controllers.problem import Problem

Vector = NDArray[np.float64]


@cache
def upper_triangle(dimension: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of a matrix's upper triangle, row by row: the order of packed entries."""
    rows, columns = np.triu_indices(dimension)
    return rows, columns


@dataclass(frozen=True)
class ThetaBlock:
    """A named part of θ: a scalar, a vector or a symmetric matrix of the given dimension.

    `kind` says which of these it is. A symmetric matrix is packed as its upper triangle row by row,
    each entry once. `scale` is the typical size of a change worth making, in the block's own units,
    `meaning` a few words, and `labels` name the entries where they have names of their own. `least`
    are the smallest values that entries may have where there are such, and `unit` (d, d) are those
    in which a matrix has no unit, ones if not given.
    """

    name: str
    kind: Literal["scalar", "vector", "symmetric"]
    dimension: int
    scale: tuple[float, ...]
    meaning: str = ""
    labels: tuple[str, ...] = ()
    least: tuple[float, ...] = ()
    unit: tuple[tuple[float, ...], ...] = ()

    @property
    def size(self) -> int:
        """Number of entries in θ."""
        return self.dimension * (self.dimension + 1) // 2 if self.symmetric else self.dimension

    @property
    def symmetric(self) -> bool:
        """Whether the block is a symmetric matrix."""
        return self.kind == "symmetric"

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the unpacked block."""
        return {
            "scalar": (),
            "vector": (self.dimension,),
            "symmetric": (self.dimension, self.dimension),
        }[self.kind]

    @cached_property
    def packed_unit(self) -> Vector:
        """Unit of each packed entry, ones where none is given."""
        if not self.unit:
            return np.ones(self.size)
        return np.array(self.unit)[upper_triangle(self.dimension)]

    def pack(self, value: ArrayLike) -> Vector:
        """Flatten an unpacked value; raises ParameterError on a wrong shape, NaN or asymmetry."""
        try:
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
        if not np.isfinite(array).all():
            raise ParameterError(f"θ block {self.name} has an entry that is not finite: {array}")
        if not self.symmetric:
            return array.reshape(-1)
        if not np.array_equal(array, array.T):
            raise ParameterError(f"θ block {self.name} must be symmetric: {array.tolist()}")
        return array[upper_triangle(self.dimension)]

    def unpack(self, packed: Vector) -> Vector:
        """Value of the block in its own shape from its packed entries."""
        if not self.symmetric:
            return packed.reshape(self.shape).copy()
        matrix = np.empty(self.shape)
        rows, columns = upper_triangle(self.dimension)
        matrix[rows, columns] = matrix[columns, rows] = packed
        return matrix


@dataclass(frozen=True)
class ThetaBlocks:
    """The blocks of θ, in order."""

    blocks: tuple[ThetaBlock, ...]

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Slice of each block in θ."""
        ends = np.cumsum([block.size for block in self.blocks])
        return {
            block.name: slice(int(end) - block.size, int(end))
            for block, end in zip(self.blocks, ends, strict=True)
        }

    @cached_property
    def size(self) -> int:
        """Length of θ."""
        return sum(block.size for block in self.blocks)

    @cached_property
    def _by_name(self) -> dict[str, ThetaBlock]:
        return {block.name: block for block in self.blocks}

    @cached_property
    def scale(self) -> Vector:
        """Learning scale of each entry of θ."""
        return np.concatenate([np.array(block.scale) for block in self.blocks])

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """A name for each entry of θ, such as `B_l[0,2]`."""
        names: list[str] = []
        for block in self.blocks:
            if block.symmetric:
                rows, columns = upper_triangle(block.dimension)
                names += [f"{block.name}[{i},{j}]" for i, j in zip(rows, columns, strict=True)]
            elif block.kind == "scalar":
                names.append(block.name)
            else:
                names += [
                    f"{block.name}[{block.labels[i] if block.labels else i}]"
                    for i in range(block.dimension)
                ]
        return tuple(names)

    def __iter__(self) -> Iterator[ThetaBlock]:
        """The blocks, in order."""
        return iter(self.blocks)

    def __contains__(self, name: str) -> bool:
        """Whether θ has a block of this name."""
        return name in self.slices

    def block(self, name: str) -> ThetaBlock:
        """Block of this name; raises ParameterError where there is none."""
        if name not in self._by_name:
            raise ParameterError(f"θ has no block '{name}'; it has {', '.join(self.slices)}")
        return self._by_name[name]

    @classmethod
    def of(
        cls,
        problem: Problem,
        *,
        slack_weights: bool = False,
        model_parameters: tuple[str, ...] = (),
    ) -> ThetaBlocks:
        """Blocks of the paper's θ for a problem (paper.tex, Simulations), and what is added to it.

        `slack_weights` adds the linear and quadratic slack weights w_sigma and W_sigma of the
        predicted stages 1…N; `model_parameters` adds a block p of physical parameters by name.
        Scales are shares of the problem's `Units`, ρ those of states and actions, κ that of cost:
        κ/ρ_iρ_j for a Hessian, 0.1 κ/ρ for a gradient, ρ/100 for a bound, κ/ρ and 1000 κ/ρ² for the
        slack weights. Raises ModelError on a parameter that the model lacks.
        """
        units = problem.units
        kappa, states = units.cost, units.state
        both = np.concatenate([states, units.action])

        def symmetric(name: str, sizes: Vector, meaning: str) -> ThetaBlock:
            unit = kappa / np.outer(sizes, sizes)
            scale = tuple(unit[upper_triangle(sizes.size)].tolist())
            rows = tuple(tuple(row) for row in unit.tolist())
            return ThetaBlock(name, "symmetric", sizes.size, scale, meaning, unit=rows)

        def vector(
            name: str, scale: Vector, meaning: str, least: tuple[float, ...] = ()
        ) -> ThetaBlock:
            entries = tuple(scale.tolist())
            return ThetaBlock(name, "vector", scale.size, entries, meaning, least=least)

        blocks = [
            symmetric("B_lambda", states, "initial cost, quadratic"),
            vector("b_lambda", 0.1 * kappa / states, "initial cost, linear"),
            ThetaBlock("c_lambda", "scalar", 1, (0.1 * kappa,), "initial cost, constant"),
            symmetric("B_Vf", states, "terminal cost, quadratic"),
            vector("b_Vf", 0.1 * kappa / states, "terminal cost, linear"),
            symmetric("B_l", both, "stage cost, quadratic"),
            vector("b_l", 0.1 * kappa / both, "stage cost, linear"),
            vector("c_f", 0.001 * states, "model offset"),
            vector("x_l", 0.01 * states, "lower state bound"),
            vector("x_u", 0.01 * states, "upper state bound"),
        ]
        if slack_weights:
            quadratic = kappa / states**2
            blocks += [
                vector(
                    "w_sigma",
                    kappa / states,
                    "slack of stages 1…N, linear weight",
                    tuple(units.exact().tolist()),
                ),
                vector(
                    "W_sigma",
                    1e3 * quadratic,
                    "slack of stages 1…N, quadratic weight",
                    tuple(quadratic.tolist()),
                ),
            ]
        if model_parameters:
            indices = problem.model.parameter_indices(model_parameters)
            scale = tuple(0.1 * abs(problem.model.parameters[i].nominal) for i in indices)
            blocks.append(
                ThetaBlock(
                    "p", "vector", len(indices), scale, "model parameters", tuple(model_parameters)
                )
            )
        return cls(tuple(blocks))
