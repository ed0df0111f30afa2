"""The exported controller and its QP solver as libraries of this machine, called by ctypes."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
import pytest

from controllers.export import Core
from controllers.export.core import ENGINE_SOURCES, QP_SOURCES
from controllers.qp import QpSolution, SoftQp

FLAGS = ("-std=c99", "-O0", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-fPIC", "-shared")

QP = """
#include "qp.h"
int solve(const Qp *qp, double *guess, double *v, double *nu, double *lam, double *measures) {
    static QpWork work;
    QpStatus status = qp_load(qp, &work);
    if (status == QP_SOLVED) status = qp_solve(qp, &work, guess);
    if (status == QP_SOLVED) qp_remember(&work, guess);
    memcpy(v, work.v, sizeof work.v);
    memcpy(nu, work.nu, sizeof work.nu);
    memcpy(lam, work.lam, sizeof work.lam);
    measures[0] = qp_residual(qp, &work);
    measures[1] = work.iterations;
    return (int)status;
}
"""

CORE = """
#include "core.h"
int size(void) { return (int)sizeof(CoreState); }
void reset(CoreState *state) { core_reset(state); }
int sample(CoreState *state, const double *s, const double *a, const double *theta, double *y) {
    core_act(state, s, a, theta);
    core_outputs(state, y);
    core_commit(state);
    return (int)state->status;
}
"""


def library(folder: Path, sources: Mapping[str, bytes], *flags: str) -> ctypes.CDLL:
    """Compile `sources` into one library and load it; skips where there is no compiler."""
    compiler = os.environ.get("CC", "cc")
    if shutil.which(compiler) is None:
        pytest.skip("there is no C compiler")
    for name, data in sources.items():
        (folder / name).write_bytes(data)
    units = [name for name in sources if name.endswith(".c")]
    subprocess.run(
        [compiler, *FLAGS, *flags, *units, "-o", "library.so", "-lm"], cwd=folder, check=True
    )
    return ctypes.CDLL(str(folder / "library.so"))


def _pointer(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)


class CompiledQpSolver:
    """The C solver for QPs of one size."""

    def __init__(self, folder: Path, variables: int, rows: int) -> None:
        sources = {name: (ENGINE_SOURCES / name).read_bytes() for name in QP_SOURCES}
        sources["solve.c"] = QP.encode()
        self._library = library(folder, sources, f"-DQP_N={variables}", f"-DQP_ROWS={rows}")
        self._sizes = variables, variables, rows

    def solve(
        self, qp: SoftQp, guess: np.ndarray | None = None
    ) -> tuple[int, QpSolution, float, int]:
        """Status, solution, the residual by the solver's own measure, and iterations.

        `guess` (variables + rows,) is the working set to begin with and becomes the solution's.
        """
        guess = np.zeros(self._sizes[0] + self._sizes[2]) if guess is None else guess
        names = ("H", "f", "lower", "upper", "rows", "row_lower", "row_upper", "w", "W")
        arrays = [np.ascontiguousarray(getattr(qp, name), dtype=np.float64) for name in names]
        data = (ctypes.c_void_p * len(names))(*[array.ctypes.data for array in arrays])
        parts = [np.zeros(size) for size in self._sizes]
        measures = np.zeros(2)
        status = self._library.solve(data, *map(_pointer, (guess, *parts, measures)))
        return status, QpSolution(*parts), float(measures[0]), int(measures[1])


class CompiledController:
    """The exported controller: `sample(s)` returns outputs by name, `sample(s, a)` in manual."""

    def __init__(self, folder: Path, core: Core, *flags: str) -> None:
        self._library = library(folder, {**core.sources, "core.c": CORE.encode()}, *flags)
        problem = core.problem
        self.n, self.m, self.horizon = problem.n_states, problem.n_actions, problem.horizon
        self.theta = np.array(core.parameters.theta)
        self._s = np.zeros(self.n)
        self._y = np.zeros(self.m * (1 + self.horizon) + 5 + (self.horizon + 1) * self.n)
        self._state = ctypes.create_string_buffer(self._library.size())
        self.reset()

    def reset(self) -> None:
        self._library.reset(self._state)

    def sample(self, s: np.ndarray, a: np.ndarray | None = None) -> dict[str, np.ndarray]:
        self._s[:] = s
        manual = None if a is None else _pointer(a)
        self._library.sample(
            self._state, _pointer(self._s), manual, _pointer(self.theta), _pointer(self._y)
        )
        cuts = np.cumsum([self.m, 1, 1, 1, 1, 1, (self.horizon + 1) * self.n])
        names = ("action", "value", "status", "residual", "iterations", "failures", "x", "u")
        return dict(zip(names, np.split(self._y.copy(), cuts), strict=True))


def random_qps(count: int, seed: int) -> Iterator[tuple[str, SoftQp]]:
    """Strictly convex QPs of 20 variables and 20 soft rows, a tenth of them of each family."""
    rng = np.random.default_rng(seed)
    for k in range(count):
        family = FAMILIES[k % len(FAMILIES)]
        yield family, _random_qp(family, rng)


FAMILIES = (
    "generic", "twin rows", "zero rows", "row equations", "fixed variables", "no limits",
    "integers", "rank one", "weakly active", "bounds as rows",
)  # fmt: skip


def _random_qp(family: str, rng: np.random.Generator) -> SoftQp:
    n = rows = 20
    root = rng.normal(size=(n, n))
    H = root @ root.T / n + 10 ** rng.uniform(-3, 0) * np.eye(n)
    H = (H + H.T) / 2 * 10 ** rng.uniform(-1, 2)
    f = rng.normal(size=n) * 10 ** rng.uniform(0, 3)
    lower, upper = [sign * rng.random(n) * 10 ** rng.uniform(-1, 2) for sign in (-1, 1)]
    A = rng.normal(size=(rows, n))
    if rng.random() < 0.5:  # the triangle of blocks that condensing makes
        A = np.where(np.arange(n) < 2 * (np.arange(rows)[:, None] // 2 + 1), A, 0)
    middle = rng.normal(size=rows) * 3
    below, above = middle - rng.random(rows) * 3, middle + rng.random(rows) * 3
    w, W = 10 ** rng.uniform(-1, 5, size=rows), 10 ** rng.uniform(-3, 4, size=rows)
    match family:
        case "twin rows":
            A[1::2] = A[::2]
        case "zero rows":
            A[rng.random(rows) < 0.3] = 0
        case "row equations":
            above = below.copy()
        case "fixed variables":
            upper = np.where(rng.random(n) < 0.3, lower, upper)
        case "no limits":
            below[rng.random(rows) < 0.5], above[rng.random(rows) < 0.5] = -np.inf, np.inf
        case "integers":  # many ties
            A, f, H = np.round(A), np.round(f), 2 * np.eye(n)
            lower, upper = np.full(n, -1.0), np.ones(n)
            below = np.round(below)
            above = np.maximum(np.round(above), below)
            w, W = np.round(w) + 1, np.ones(rows)
        case "rank one":
            A = np.outer(rng.normal(size=rows), rng.normal(size=n))
        case "weakly active":  # limits through the optimum without limits
            f /= max(1.0, np.abs(np.linalg.solve(H, f)).max() / 50)
            v = -np.linalg.solve(H, f)
            on_lower, y = rng.random(n) < 0.5, A @ v
            lower, upper = np.where(on_lower, v, v - 1), np.where(on_lower, v + 1, v)
            below, above = y - (rng.random(rows) < 0.5), y + (rng.random(rows) < 0.5)
        case "bounds as rows":
            A[:10], below[:10], above[:10] = np.eye(n)[:10], lower[:10], upper[:10]
    return SoftQp(H, f, lower, upper, A, below, above, w, W)
