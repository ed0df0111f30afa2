"""A model of a plant from its own operation: what the controller's nominal model lacks.

(s₊, ℓ) = y(s, a; c) + W (1, s, a) + h(s, a) r. y is the nominal model with its economic cost, whose
parameters and nominal disturbances are c times their value larger. h is the size of the error that
disturbances in proportion to their values would make. c and W are estimated from transitions by
Bayesian generalised least squares, in Gauss-Newton steps since y is not linear in c; the width of
the prior of W's slopes is the one of greatest evidence (MacKay 1992). The residuals r are kept and
drawn anew. The model knows no parameter of the plant and no law of its disturbances.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from controllers.export.core import core
from controllers.functions import c_source, library, not_in_c, work_sizes
from controllers.model import discretise, economic_cost
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.protocols import Array
from cosim.simulation import recover
from learning.algorithm import Transition
from learning.checkpoint import State, take_up

PARAMETER_DEVIATION = 0.15
"""Prior standard deviation of a parameter's error, as a share of its value."""
MOST = 0.5
"""Largest such error."""
SLOPE_DEVIATIONS = (0.1, 0.01, 0.001)
"""Those of W's slopes to choose from, in standard deviations of the error over one of the input."""
FLOOR = 0.1
"""Least h, as a share of its value at the reference."""
EXACT = 1e-6
"""Least deviation of an output, as a share of its size: two integrators differ by as much."""
ROUNDS, ENOUGH = 6, 2000
"""Fits, each about the parameters and with the residuals' covariance of the one before, and samples
of which all but the last take no more than twice as many."""
ALARM, SUSPICION = 1e-7, 1e-4
"""Probability below which the mean error since the last fit speaks of another plant, alone and
where the samples are dearer than was promised too."""
WINDOWS = (15, 60, 240, 960)
"""Latest samples of which that mean is taken, every `WINDOWS[0]` samples."""
FORETOLD, EVIDENCE = 240, 3.0
"""Samples, at least, and nats by which the older data must spoil their prediction to be dropped."""
BLOCK = 250
"""Rows of the fit that are factored at a time."""
GROWTH = 8
"""A model of many samples is fitted anew where its data have grown by one in so many."""
POOL = 480
"""Number of residuals up to which those from before a change are kept."""


class Features:
    """The nominal model as a function of its parameters' errors c (p,), for K = n + 1 outputs.

    `mean` is y (K,) and h (K,) of (s, a, c), a CasADi function; h is that of c = 0. The cost is the
    last output.
    """

    def __init__(self, problem: Problem) -> None:
        model = problem.model
        x, u, d, p = model.symbols()
        step = discretise(model, problem.sampling_time, problem.substeps)(x, u, d, p)
        outputs = ca.vertcat(step, economic_cost(model)(x, u, d, p))
        nominal = ca.DM([*model.nominal_parameters, *model.nominal_disturbance])
        c = ca.SX.sym("c", nominal.numel())
        (y,) = ca.substitute([outputs], [ca.vertcat(p, d)], [nominal * (1 + c)])
        G = ca.jacobian(y, c)
        by_disturbance = ca.substitute(G[:, p.numel() :], c, ca.DM.zeros(c.shape))
        size = ca.sqrt(ca.sum2(by_disturbance**2))
        at = ca.Function("size", [x, u], [size])
        reference = at(problem.reference_state, problem.reference_action).full()[:, 0]
        sizes = zip(ca.vertsplit(size), reference, strict=True)
        h = ca.vertcat(*(ca.fmax(own, FLOOR * at) if at > 0 else 1.0 for own, at in sizes))
        given, names = [x, u, c], ["x", "u", "c"]
        y, G, h = (ca.densify(part) for part in (y, G, h))
        self.mean = ca.Function("nominal", given, [y, h], names, ["y", "h"])
        self._function = ca.Function("features", given, [y, G.T, h], names, ["y", "G", "h"])
        self.outputs, self.count = G.shape
        self.inputs = problem.n_states + problem.n_actions
        self.compiled = None
        if not_in_c([self._function]) is not None:
            return
        constants = {
            "N_X": problem.n_states,
            "N_IN": self.inputs,
            "K": self.outputs,
            "P": self.count,
            **work_sizes("FEATURES", self._function),
        }
        path = library(
            {
                "sizes.h": _definitions(constants),
                "nominal.h": "#define CASADI_SYMBOL_EXPORT static\n" + c_source([self._function]),
                "features.c": (files("learning") / "features.c").read_bytes(),
            }
        )
        if path is not None:
            self.compiled = ctypes.CDLL(str(path)).features_at

    def __call__(self, inputs: Array, c: Array) -> tuple[Array, Array, Array]:
        """y (M, K), its derivative by c, G (M, K, p), and h (M, K) at inputs (s, a), (M, n+m)."""
        M, n, K = len(inputs), self.outputs - 1, self.outputs
        if self.compiled is not None:
            y, G, h = np.empty((M, K)), np.empty((M, K, self.count)), np.empty((M, K))
            rows = np.ascontiguousarray(inputs)
            self.compiled(*_pointers(rows, c), ctypes.c_longlong(M), *_pointers(y, G, h))
            return y, G, h
        results = self._function(inputs[:, :n].T, inputs[:, n:].T, c)
        y, G, h = (part.full() for part in results)
        return y.T, G.T.reshape(M, K, self.count), h.T


@dataclass(frozen=True)
class EmpiricalModel:
    """The estimate from M transitions.

    `mean` (p + K(1+n+m),) has c, then W row by row for the inputs (1, s, a), standardised by
    `centre` and `unit` (n+m,); `covariance` is its posterior's;
    `residuals` (M, K) are r, mean zero.
    """

    KEPT: ClassVar = ("centre", "unit", "mean", "covariance", "residuals")
    features: Features
    centre: Array
    unit: Array
    mean: Array
    covariance: Array
    residuals: Array

    @classmethod
    def fit(
        cls, features: Features, inputs: Array, outputs: Array, pool: Array | None = None
    ) -> EmpiricalModel:
        """Estimate from inputs (s, a), (M, n+m), and outputs (s₊, ℓ), (M, K).

        `pool` has residuals (·, K) of an earlier estimate, which are kept beside the new ones.
        """
        centre, unit = inputs.mean(axis=0), inputs.std(axis=0)
        unit = np.where(unit > 0, unit, 1.0)
        thinned, p = max(len(inputs) // ENOUGH, 1), features.count
        y, _, h = features(inputs[::thinned], c := np.zeros(p))
        deviation = (outputs[::thinned] - y).std(axis=0) + 1e-9 * np.abs(y).mean(axis=0)
        parameters = np.full(p, PARAMETER_DEVIATION)
        priors = [
            np.append(parameters, np.outer(deviation, [1.0] + [slopes] * features.inputs))
            for slopes in SLOPE_DEVIATIONS
        ]
        older = np.empty((0, features.outputs)) if pool is None else pool
        residuals = (outputs[::thinned] - y) / h
        residuals = residuals - residuals.mean(axis=0)
        least = EXACT**2 * ((y / h) ** 2).mean(axis=0)
        for step in (*[thinned] * (ROUNDS - 1), 1):
            some, given = inputs[::step], outputs[::step]
            y, G, h = features(some, c)
            known = np.concatenate([residuals, older])
            noise = known.T @ known / len(known)
            variance = np.diag(noise)
            noise = noise + np.diag(np.maximum(least - variance, 1e-9 * variance))
            design = _design(G, (some - centre) / unit) / h[:, :, None]
            mean, covariance = _posterior(design, (given - y + G @ c) / h, noise, priors)
            c = mean[:p] = mean[:p].clip(-MOST, MOST)
            y, _, _ = features(some, c)
            residuals = (given - y) / h - design[:, :, p:] @ mean[p:]
        residuals = np.concatenate([residuals - residuals.mean(axis=0), older])
        return cls(features, centre, unit, mean, covariance, residuals)

    def predict(self, inputs: Array) -> tuple[Array, Array, Array]:
        """Predictions of (s₊, ℓ) without r, h (M, K), and their derivative by `mean` over h."""
        p = self.features.count
        y, G, h = self.features(inputs, self.mean[:p])
        design = _design(G, (inputs - self.centre) / self.unit) / h[:, :, None]
        return y + h * (design[:, :, p:] @ self.mean[p:]), h, design

    def lack(self, inputs: Array, c: Array) -> Array:
        """What predictions of s₊ by y(s, a; c) lack on average at inputs (M, n+m), (n,)."""
        y, _, _ = self.features(inputs, c)
        mean: Array = (self.predict(inputs)[0] - y)[:, :-1].mean(axis=0)
        return mean

    def cost_row(self, inputs: Array) -> Array:
        """Derivative of the mean cost at inputs (M, n+m) by `mean`."""
        _, G, _ = self.features(inputs, self.mean[: self.features.count])
        row: Array = _design(G, (inputs - self.centre) / self.unit)[:, -1].mean(axis=0)
        return row

    @cached_property
    def noise(self) -> Array:
        """Covariance of the residuals, (K, K)."""
        return np.cov(self.residuals.T)

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """c (p,) and W (K, 1+n+m) for inputs in their own units."""
        c, W = self.mean[: self.features.count], self.mean[self.features.count :]
        W = W.reshape(self.features.outputs, -1)
        slopes = W[:, 1:] / self.unit
        return c, np.column_stack([W[:, 0] - slopes @ self.centre, slopes])


class PlantData:
    """The latest transitions of a plant in operation, and the `model` of the plant as it is now.

    `count` samples so far, `era` of them before the present plant's, `fitted` at the last fit.
    """

    KEPT = ("_rows", "_pool", "count", "era", "fitted", "model")

    def __init__(self, features: Features, memory: int) -> None:
        self.features = features
        self.model: EmpiricalModel | None = None
        self.count, self.era, self.fitted = 0, 0, 0
        # A ring of transitions (s, a, s₊, ℓ), and the residuals from before the last change.
        self._rows = np.zeros((memory, features.inputs + features.outputs))
        self._pool = np.zeros((0, features.outputs))
        # Of each `WINDOWS[0]` samples since the fit what `errors` says of them.
        self._judged: list[tuple[Array, Array, Array, Array]] = []

    def add(self, transition: Transition) -> None:
        """Keep a transition in place of the oldest one."""
        row = (transition.s, transition.a, transition.next_s, [transition.stage_cost])
        self._rows[self.count % len(self._rows)] = np.concatenate(row)
        self.count += 1

    def latest(self, count: int) -> tuple[Array, Array]:
        """Inputs (s, a) and outputs (s₊, ℓ) of so many of the latest samples, oldest first."""
        count = min(count, self.count, len(self._rows))
        rows = self._rows[np.arange(self.count - count, self.count) % len(self._rows)]
        return rows[:, : self.features.inputs], rows[:, self.features.inputs :]

    @property
    def present(self) -> tuple[Array, Array]:
        """Inputs and outputs of the plant as it is now."""
        return self.latest(self.count - self.era)

    def fit(self) -> EmpiricalModel:
        """Fit the model to the plant as it is now; data that spoil its predictions are dropped."""
        inputs, outputs = self.present
        if outdated := self._outdated(inputs, outputs):
            self.era = self.count - len(inputs) + outdated
            inputs, outputs = self.present
        pool = self._pool[: max(POOL - len(inputs), 0)]
        self.model = model = EmpiricalModel.fit(self.features, inputs, outputs, pool)
        self.fitted, self._judged = self.count, []
        return model

    def _outdated(self, inputs: Array, outputs: Array) -> int:
        """Number of oldest samples without which the model foretells the latest quarter better."""
        latest = len(inputs) // 4
        if latest < FORETOLD:
            return 0
        older, losses = (len(inputs) - latest) // 2, []
        models = [
            EmpiricalModel.fit(self.features, inputs[first:-latest], outputs[first:-latest])
            for first in (0, older)
        ]
        precision = np.linalg.pinv(models[1].noise)
        for model in models:
            predicted, h, _ = model.predict(inputs[-latest:])
            errors = (outputs[-latest:] - predicted) / h
            losses.append(float(np.einsum("mi,ij,mj->", errors, precision, errors)) / 2)
        return older if losses[0] - losses[1] > EVIDENCE else 0

    def errors(self) -> tuple[Array, Array, Array, Array]:
        """Predictions, h, errors over h and designs of the samples since the fit.

        Of the latest `WINDOWS[-1]` of them at most; a last part below `WINDOWS[0]` is left out.
        """
        assert self.model is not None
        block, judged = WINDOWS[0], self._judged
        since = self.count - self.fitted
        inputs, outputs = self.latest(since - block * len(judged))
        for first in range(0, len(inputs) - block + 1, block):
            at = slice(first, first + block)
            predicted, h, designs = self.model.predict(inputs[at])
            judged.append((predicted, h, (outputs[at] - predicted) / h, designs))
        parts = zip(*judged[-WINDOWS[-1] // block :], strict=True)
        predicted, h, errors, designs = (np.concatenate(part) for part in parts)
        return predicted, h, errors, designs

    def changed(self, errors: Array, designs: Array, suspect: Sequence[int] = ()) -> bool:
        """Whether the mean of `errors` (T, K), with their designs, is improbable in a window.

        The data of the present plant begin with that window then. In `suspect` ones less improbable
        is enough.
        """
        model = self.model
        assert model is not None
        M, K = model.residuals.shape
        for window in WINDOWS:
            if window > len(errors):
                break
            mean, design = errors[-window:].mean(axis=0), designs[-window:].mean(axis=0)
            covariance = model.noise / window + design @ model.covariance @ design.T
            statistic = mean @ np.linalg.solve(covariance, mean) * (M - K) / (K * (M - 1))
            alarm = SUSPICION if window in suspect else ALARM
            if fdtrc(K, M - K, max(statistic, 0.0)) < alarm:
                self.era, self._pool = self.count - window, model.residuals[-POOL:]
                return True
        return False

    def restore(self, state: State) -> None:
        """Take back what a checkpoint has of this."""
        take_up(self, state)
        if state["model"] is not None:
            self.model = EmpiricalModel(self.features, **state["model"])


class Rollout:
    """The RTI-NMPC of a problem in closed loop with empirical models.

    In C; without a compiler in Python, many times slower. θ and the model are arguments of each
    call, so that one library serves a problem.
    """

    def __init__(self, problem: Problem, parameters: Parameters, features: Features) -> None:
        self._problem, self._features = problem, features
        self._controller = RtiNmpc(problem, parameters)
        self.compiled = None
        function = features.mean
        if not_in_c([function]) is not None:
            return
        sizes = {"K": features.outputs, **work_sizes("NOMINAL", function)}
        sources: dict[str, str | bytes] = {
            **core(problem, parameters).sources,
            "sizes.h": _definitions(sizes),
            # Where a function says that it is exported, Windows exports no other.
            "nominal.c": "#define CASADI_SYMBOL_EXPORT\n" + c_source([function]),
            "rollout.c": (files("learning") / "rollout.c").read_bytes(),
        }
        path = library(sources)
        if path is not None:
            self.compiled = ctypes.CDLL(str(path)).rollout

    def __call__(
        self, thetas: Sequence[Array], start: Array, model: EmpiricalModel, picks: NDArray[np.int32]
    ) -> list[tuple[Array, Array, Array]]:
        """For each θ inputs (s, a), predictions of (s₊, ℓ) without r, and h, (T, …) each.

        θ (n_θ,); `start` (n,); `picks` (T,) says which of the model's residuals each sample meets.
        Where the QP fails the last action is repeated. Fewer samples where a state is not finite.
        The compiled rollouts of several θ run at once, in threads.
        """
        with ThreadPoolExecutor(1 if self.compiled is None else None) as pool:
            return list(pool.map(lambda theta: self._one(theta, start, model, picks), thetas))

    def _one(
        self, theta: Array, start: Array, model: EmpiricalModel, picks: NDArray[np.int32]
    ) -> tuple[Array, Array, Array]:
        shape, steps = (len(picks), self._features.outputs), len(picks)
        inputs = np.empty((steps, self._features.inputs))
        predicted, h = np.empty(shape), np.empty(shape)
        if self.compiled is not None:
            given = (theta, start, *model.coefficients, model.residuals, picks)
            arrays = [np.ascontiguousarray(array) for array in given]
            steps = self.compiled(*_pointers(*arrays), steps, *_pointers(inputs, predicted, h))
            return inputs[:steps], predicted[:steps], h[:steps]
        problem, controller, s = self._problem, self._controller, start
        (c, W), a = model.coefficients, problem.reference_action
        controller.theta = theta
        controller.reset()
        with np.errstate(over="ignore", invalid="ignore"):  # of a loop that runs away
            for step, pick in enumerate(picks):
                if not np.isfinite(s).all():
                    return inputs[:step], predicted[:step], h[:step]
                try:
                    controller.prepare()
                    a = np.clip(
                        controller.feedback(s).action, problem.action_lower, problem.action_upper
                    )
                except Exception as error:
                    recover(controller, error)
                inputs[step] = np.concatenate([s, a])
                y, size = self._features.mean(s, a, c)
                predicted[step] = y.full()[:, 0] + W @ np.append(1.0, inputs[step])
                h[step] = size.full()[:, 0]
                s = (predicted[step] + h[step] * model.residuals[pick])[:-1]
        return inputs, predicted, h


def _pointers(*arrays: NDArray[Any]) -> list[ctypes.c_void_p]:
    return [ctypes.c_void_p(array.ctypes.data) for array in arrays]


def _definitions(sizes: Mapping[str, int]) -> str:
    return "".join(f"#define {name} {value}\n" for name, value in sizes.items())


def _design(G: Array, standardised: Array) -> Array:
    """Rows (M, K, p + K(1+n+m)) of the regression."""
    M, K, p = G.shape
    inputs = np.column_stack([np.ones(M), standardised])
    q = inputs.shape[1]
    design = np.zeros((M, K, p + K * q))
    design[:, :, :p] = G
    for i in range(K):
        design[:, i, p + i * q : p + (i + 1) * q] = inputs
    return design


def _triangle(rows: Array) -> Array:
    """R (q, q) of the QR factors of rows (M, q), M ≥ q.

    Some outputs are nearly exact, others noisy: normal equations would lose the latter. Blocks that
    fit in a processor's cache are factored first, which takes a third of the time.
    """
    whole = len(rows) // BLOCK * BLOCK
    blocks = np.linalg.qr(rows[:whole].reshape(-1, BLOCK, rows.shape[1]), mode="r")
    return np.asarray(np.linalg.qr(np.concatenate([*blocks, rows[whole:]]), mode="r"))


def _posterior(
    design: Array, target: Array, noise: Array, priors: Sequence[Array]
) -> tuple[Array, Array]:
    """Mean and covariance of the coefficients, with the prior deviations of greatest evidence."""
    whiten = np.linalg.inv(np.linalg.cholesky(noise))
    rows = (whiten @ design).reshape(-1, design.shape[2])
    rows = np.column_stack([rows, (target @ whiten.T).reshape(-1)])
    R = _triangle(rows)
    found = []
    for prior in priors:
        Q, root = np.linalg.qr(np.concatenate([R[:, :-1] * prior, np.eye(prior.size)]))
        moment = Q[: len(R)].T @ R[:, -1]
        factor = prior[:, None] * np.linalg.inv(root)
        evidence = moment @ moment / 2 - np.log(np.abs(np.diag(root))).sum()
        found.append((float(evidence), factor @ moment, factor @ factor.T))
    _, mean, covariance = max(found, key=lambda item: item[0])
    return mean, covariance
