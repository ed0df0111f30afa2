"""θ as a CasADi symbol, with its blocks unpacked and the model's parameters in their places."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca

from controllers.problem import Problem
from controllers.theta import ThetaBlocks


def symmetric(packed: ca.SX, dimension: int) -> ca.SX:
    """Symmetric matrix from its upper triangle, row by row."""
    matrix = ca.SX(dimension, dimension)
    position = 0
    for i in range(dimension):
        for j in range(i, dimension):
            matrix[i, j] = matrix[j, i] = packed[position]
            position += 1
    return matrix


@dataclass(frozen=True)
class SymbolicTheta:
    """θ as one symbol; `symbols["B_l"]` is a whole block, or the problem's constant without one.

    `theta` (n_θ,) is the symbol, `unpacked` holds the blocks by name, and `model_parameters` (n_p,)
    are the model's, with θ's own in their places.
    """

    theta: ca.SX
    unpacked: dict[str, ca.SX]
    model_parameters: ca.SX

    def __getitem__(self, name: str) -> ca.SX:
        """Unpacked symbol of a block."""
        return self.unpacked[name]

    @classmethod
    def of(cls, problem: Problem, blocks: ThetaBlocks) -> SymbolicTheta:
        """Symbols for these blocks of θ."""
        theta = ca.SX.sym("theta", blocks.size)
        unpacked = {}
        for block in blocks:
            part = theta[blocks.slices[block.name]]
            unpacked[block.name] = symmetric(part, block.dimension) if block.symmetric else part
        unpacked.setdefault("w_sigma", ca.SX(ca.DM(problem.penalty_linear)))
        unpacked.setdefault("W_sigma", ca.SX(ca.DM(problem.penalty_quadratic)))
        parameters = ca.SX(ca.DM(problem.model.nominal_parameters))
        if "p" in blocks:
            for i, index in enumerate(problem.model.parameter_indices(blocks.block("p").labels)):
                parameters[index] = unpacked["p"][i]
        return cls(theta, unpacked, parameters)
