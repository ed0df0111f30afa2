"""Finite differences of one and the same feedback step, and how near a gradient must come."""

from collections.abc import Callable

import numpy as np

from controllers import LinearisationPoint, Parameters, RtiNmpc, RtiSolution
from controllers.preparation import Spectrum

STEPS = (1e-2, 1e-3, 1e-4, 1e-5, 1e-6)
SOLVER = 1e-11  # of an action; DAQP is good to its primal tolerance, 1e-10
TOLERANCE = 1e-6


class Feedback:
    """V or Q of a controller as a function of (θ, s, a) at one linearisation point."""

    def __init__(
        self, controller: RtiNmpc, theta: np.ndarray, point: LinearisationPoint, s: np.ndarray
    ) -> None:
        self.controller, self.theta, self.point, self.s = controller, theta, point, s

    def __call__(self, theta=None, s=None, a=None) -> RtiSolution:
        self.controller.theta = self.theta if theta is None else theta
        self.controller.prepare_at(self.point)
        return self.controller.feedback(self.s if s is None else s, a)


def activity(solution: RtiSolution) -> bytes:
    """Which limits are active, which eigenvalues are lifted, which true bounds s violates."""
    problem, s = solution.prepared.functions.problem, solution.predicted_states[0]
    masks = [*solution.multipliers.active(solution.qp), s < problem.state_lower]
    spectrum = solution.prepared.spectrum
    if isinstance(spectrum, Spectrum):
        masks.append(spectrum.values > spectrum.floor)
    return b"".join(mask.tobytes() for mask in (*masks, s > problem.state_upper))


def value_error(solution: RtiSolution) -> float:
    """Rounding, and what the slope of the cost makes of limits that v does not quite meet.

    The slope is w at a row, by the slack, and |ν| at a bound or an enforced action.
    """
    qp, v, nu = solution.qp, solution.multipliers.v, solution.multipliers.nu
    held, at_limit, _ = solution.multipliers.active(qp)
    gap = np.minimum(np.abs(v - qp.lower), np.abs(v - qp.upper))
    slack = np.maximum(np.maximum(qp.row_lower - qp.rows @ v, qp.rows @ v - qp.row_upper), 0.0)
    rounding = 64 * np.finfo(float).eps * abs(solution.value)
    unmet = float((qp.w * slack)[at_limit].sum() + (np.abs(nu) * gap)[held].sum())
    # The QP's costs are in units of `Problem.scale`, the value is in the model's.
    return rounding + float(solution.prepared.functions.problem.scale.cost) * unmet


def derivative(
    evaluate: Callable[[np.ndarray], RtiSolution], at: np.ndarray, scale: np.ndarray
) -> dict[str, np.ndarray]:
    """Derivatives of value and action by Romberg's extrapolation of central differences.

    Each entry takes the largest step that leaves the active set as it is. Returns `value` (size,),
    `action` (m, size) and what the errors of the values and of the QP's solution make of them:
    `value_noise` and `action_noise` (size,).
    """
    base = evaluate(at)
    active = activity(base)
    values, actions, steps, errors = [], [], [], []
    for i in range(at.size):
        for relative in STEPS:
            h = relative * scale[i]
            ends = {}
            for multiple in (1, -1, 0.5, -0.5, 0.25, -0.25):
                moved = at.copy()
                moved[i] += multiple * h
                ends[multiple] = evaluate(moved)
                if activity(ends[multiple]) != active:
                    break
            else:
                break
        else:
            raise AssertionError(f"no step in entry {i} leaves the active set alone")

        def romberg(read, ends=ends, h=h):
            d1, d2, d4 = ((read(ends[c]) - read(ends[-c])) / (2 * c * h) for c in (1, 0.5, 0.25))
            first, second = (4 * d2 - d1) / 3, (4 * d4 - d2) / 3
            return (16 * second - first) / 15

        values.append(romberg(lambda end: end.value))
        actions.append(romberg(lambda end: end.action))
        steps.append(h)
        errors.append(max(value_error(end) for end in ends.values()))
    amplified = 8 / np.array(steps)
    return {
        "value": np.array(values),
        "value_noise": amplified * np.array(errors),
        "action": np.array(actions).T,
        "action_noise": amplified * SOLVER,
    }


def natural_scale(parameters: Parameters) -> np.ndarray:
    """Size of each entry of θ, at least one; for the costs' Hessians √(B_ii B_jj)."""
    scale = np.maximum(np.abs(parameters.theta), 1)
    for name in ("B_l", "B_Vf"):
        root = np.sqrt(np.diag(parameters[name]))
        scale[parameters.blocks.slices[name]] = np.outer(root, root)[np.triu_indices(root.size)]
    return scale


def assert_close(found, expected, parts, label, noise=0.0) -> None:
    """|found − expected| ≤ 1e-6·max(|expected|, the part's largest) plus the differences' noise."""
    for name, part in parts.items():
        error = np.abs(found[..., part] - expected[..., part])
        largest = np.abs(expected[..., part]).max()
        allowed = TOLERANCE * largest + np.broadcast_to(noise, expected.shape)[..., part]
        assert (error <= allowed).all(), (
            f"{label}, {name}: differs by {error.max():.2e}, largest {largest:.2e}"
        )
