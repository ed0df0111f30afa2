"""The prior on θ: how far each entry may be from where it starts, without units of any plant.

Widths come from three things that every plant has: the start's own cost, the movement of its
states (standard deviations of s and of the prediction error e), and the range of its inputs.
Rescaling a state, an input or the cost rescales them all alike.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters

Vector = NDArray[np.float64]
LEVEL = 0.16
"""Width of c_lambda as a share of V's level, which is all that it carries."""
OFFSET = 0.02
"""Width of c_f in standard deviations of e: its mean is measured, the TD error need not say it."""
BACK_OFF = 2.0
"""Width of x_l and x_u in standard deviations of e."""
SLOW = 0.3
"""A slow state moves by this share of its standard deviation where that is more than e's."""
GRADIENT = 0.3
"""Width of a cost gradient as a share of the start's, where that is more than a shift's."""


def prior_deviation(
    start: Parameters,
    state_deviation: Vector,
    error_deviation: Vector,
    action_deviation: Vector,
    level: float,
    width: float,
) -> Vector:
    """Standard deviation of each entry of θ about its start, (n_θ,).

    With B a Hessian of the start and D = diag(B)^½: entries of B get `width`·D_i D_j, so that a
    change keeps B's proportions; gradients `width`·D_i √κ, a shift of the minimum that costs about
    κ = max_i B_ii σ_i², the dearest typical move, or a share of the gradient that is there. λ_θ,
    which the policy does not feel, is as wide as V^f_θ or as its own start. Bounds get
    2·width/0.3 deviations of e, or of a slow state's movement; c_f little, since the mean of e says
    what it must be; slack weights `width` of themselves. `state_deviation` and `error_deviation`
    (n,), `action_deviation` (m,) are σ of s, e and the exploration, `level` the size of c_lambda.
    """
    move = np.concatenate([np.maximum(state_deviation, error_deviation), action_deviation])
    stage, terminal = _root_diagonal(start["B_l"]), _root_diagonal(start["B_Vf"])
    initial = np.maximum(terminal, np.sqrt(np.abs(np.diag(start["B_lambda"]))))
    dearest = float((stage * move).max())
    bound = BACK_OFF * width / 0.3 * np.maximum(error_deviation, SLOW * state_deviation)
    widths = {
        "B_lambda": width * _packed(initial),
        "b_lambda": width * np.maximum(terminal * dearest, np.abs(start["b_lambda"])),
        "c_lambda": np.array([LEVEL * abs(level)]),
        "B_Vf": width * _packed(terminal),
        "b_Vf": width * np.maximum(terminal * dearest, GRADIENT * np.abs(start["b_Vf"])),
        "B_l": width * _packed(stage),
        "b_l": width * np.maximum(stage * dearest, GRADIENT * np.abs(start["b_l"])),
        "c_f": OFFSET * error_deviation,
        "x_l": bound,
        "x_u": bound,
    }
    for name in ("w_sigma", "W_sigma", "p"):
        if name in start.blocks:
            widths[name] = width * np.abs(start[name])
    floor = np.finfo(np.float64).tiny ** 0.25
    deviation: Vector = np.concatenate([widths[block.name] for block in start.blocks])
    return np.maximum(deviation, floor)


def measured_prior(
    start: Parameters,
    states: NDArray[np.float64],
    errors: NDArray[np.float64],
    action_deviation: Vector,
    noise: float,
    width: float,
    *,
    measure_offset: bool,
) -> tuple[Parameters, Vector]:
    """Mean and deviation (n_θ,) of the prior by the first samples' states and errors e, (K, n).

    The mean is the start, with `measure_offset` c_f at the mean of e.
    `noise` is the standard deviation of the TD errors, which c_lambda's level is not below.
    """
    if measure_offset:
        start = start.replace({"c_f": errors.mean(axis=0)})
    level = max(abs(float(start["c_lambda"])), noise)
    deviation = prior_deviation(
        start,
        states.std(axis=0),
        errors.std(axis=0),
        action_deviation,
        level,
        width,
    )
    return start, deviation


def _root_diagonal(matrix: NDArray[np.float64]) -> Vector:
    root: Vector = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    return root


def _packed(root: Vector) -> Vector:
    """D_i D_j of the upper triangle, row by row."""
    triangle: Vector = np.outer(root, root)[np.triu_indices(root.size)]
    return triangle
