"""The stored set of QPs from real closed-loop runs: θ, state, action, linearisation point.

`python -m benchmarks.record_qps` regenerates it.
"""

from collections.abc import Iterable, Iterator
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from controllers import LinearisationPoint, Parameters, RtiNmpc, RtiSolution, ThetaBlocks
from tests.helpers.sampling import evaporator_problem

PATH = Path(__file__).parents[1] / "controllers" / "data" / "qps.npz"
HESSIANS = ("gauss-newton", "exact")


class StoredQp(NamedTuple):
    """One QP: its Hessian rule, θ, state, enforced action or None, and linearisation point."""

    hessian: str
    parameters: Parameters
    s: np.ndarray
    a: np.ndarray | None
    point: LinearisationPoint


@lru_cache(maxsize=1)
def blocks() -> ThetaBlocks:
    """All θ of the set have slack weights; the paper's own are set to the true penalty."""
    return ThetaBlocks.from_problem(evaporator_problem(), slack_weights=True)


def write(runs: list[tuple[str, Parameters]], samples: list[tuple[int, StoredQp]]) -> None:
    """Store θ and Hessian rule by run, the rest by sample; no action is stored as NaN."""
    nothing = np.full(2, np.nan)
    np.savez_compressed(
        PATH,
        hessian=np.array([HESSIANS.index(hessian) for hessian, _ in runs], dtype=np.uint8),
        theta=np.array([parameters.theta for _, parameters in runs]),
        run=np.array([run for run, _ in samples], dtype=np.uint8),
        s=np.array([qp.s for _, qp in samples]),
        a=np.array([nothing if qp.a is None else qp.a for _, qp in samples]),
        x=np.array([qp.point.x for _, qp in samples]),
        u=np.array([qp.point.u for _, qp in samples]),
        costates=np.array([qp.point.costates for _, qp in samples]),
    )


@lru_cache(maxsize=1)
def qps() -> tuple[StoredQp, ...]:
    """The whole set."""
    with np.load(PATH, allow_pickle=False) as stored:
        data = {name: stored[name] for name in stored.files}
    thetas = [Parameters(blocks(), theta) for theta in data["theta"]]
    return tuple(
        StoredQp(
            HESSIANS[data["hessian"][run]],
            thetas[run],
            s,
            None if np.isnan(a).any() else a,
            LinearisationPoint(*point),
        )
        for run, s, a, *point in zip(
            *(data[name] for name in ("run", "s", "a", "x", "u", "costates")), strict=True
        )
    )


@cache
def _controllers(backend: str) -> dict[str, RtiNmpc]:
    problem, theta = evaporator_problem(), qps()[0].parameters
    return {name: RtiNmpc(problem, theta, hessian=name, backend=backend) for name in HESSIANS}


def prepared(
    backend: str, picked: Iterable[int] | None = None
) -> Iterator[tuple[RtiNmpc, StoredQp]]:
    """The QPs of the set, or those picked, each with a controller prepared for it.

    The controllers start with a new workspace and keep it from QP to QP, as a run does.
    """
    for controller in _controllers(backend).values():
        controller.reset()
    for k in range(len(qps())) if picked is None else picked:
        qp = qps()[k]
        controller = _controllers(backend)[qp.hessian]
        if controller.parameters is not qp.parameters:
            controller.parameters = qp.parameters
        controller.prepare_at(qp.point)
        yield controller, qp


def solve(backend: str, picked: Iterable[int] | None = None) -> Iterator[RtiSolution]:
    """Solutions of the set, or of the QPs picked."""
    for controller, qp in prepared(backend, picked):
        yield controller.feedback(qp.s, qp.a)
