"""What the preparation phase leaves for feedbacks and for read-outs long after it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.buffered import StackedFunction
from controllers.parameters import Parameters
from controllers.problem import Problem
from controllers.rti.hessian import Lift

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]


class LinearisationPoint(NamedTuple):
    """Where a QP is linearised: states x (N, n), actions u (N, m), costates (N, n).

    The state at stage N is not needed since the terminal cost is quadratic; the costates χ_1 … χ_N
    matter for the exact Hessian only.
    """

    x: Matrix
    u: Matrix
    costates: Matrix


@dataclass(frozen=True)
class Functions:
    """The CasADi functions that a controller of the `problem` calls.

    `preparation` and `embedding` make the QP, `readout` takes its value, `gradient` and `policy`
    its derivatives in θ (`controllers.sensitivities`).
    """

    problem: Problem
    preparation: StackedFunction
    embedding: StackedFunction
    readout: StackedFunction
    gradient: StackedFunction
    policy: StackedFunction


class Prepared(NamedTuple):
    """What the preparation phase fixed, kept for read-outs after the next one has begun.

    The linearisation `point` and `parameters`; `stack` all that the preparation computed; `L`
    (N, n+m, n+m) and `L_N` (n, n) the Hessians of the stages; `w` and `W` the slack weights of the
    QP's rows; `spectrum` what convexified them, None for Gauss–Newton; `functions` its maker's.
    """

    point: LinearisationPoint
    parameters: Parameters
    stack: Vector
    L: Vector
    L_N: Vector
    w: Vector
    W: Vector
    spectrum: Lift | None
    functions: Functions
