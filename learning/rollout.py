"""Rollouts: the RTI-NMPC of a problem in closed loop with an empirical model."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.export.core import core
from controllers.functions import c_source, library, not_in_c, work_sizes
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.protocols import Array
from cosim.core.simulation import recover
from learning.empirical_model import EmpiricalModel, Features, c_definitions, pointers


class RolloutSamples(NamedTuple):
    """The samples of a rollout, T of them.

    Attributes:
        inputs: (s, a), (T, n+m).
        predicted: (s₊, ℓ) without residual, (T, K).
        h: sizes of the errors, (T, K).
    """

    inputs: Array
    predicted: Array
    h: Array


class Rollout:
    """The RTI-NMPC of a problem in closed loop with empirical models.

    In C; without a compiler in Python, many times slower. θ and the model are arguments of each
    call, so that one library serves a problem.
    """

    def __init__(
        self,
        problem: Problem,
        parameters: Parameters,
        features: Features,
    ) -> None:
        self._problem = problem
        self._features = features
        self._controller = RtiNmpc(problem, parameters)
        self.compiled = None
        function = features.mean
        if not_in_c([function]) is not None:
            return
        # The nominal model as C beside the controller's: both in one library.
        sizes = {"K": features.n_outputs, **work_sizes("NOMINAL", function)}
        sources: dict[str, str | bytes] = {
            **core(problem, parameters).sources,
            "sizes.h": c_definitions(sizes),
            # Where a function says that it is exported, Windows exports no other.
            "nominal.c": "#define CASADI_SYMBOL_EXPORT\n" + c_source([function]),
            "rollout.c": (files("learning") / "rollout.c").read_bytes(),
        }
        path = library(sources)
        if path is not None:
            self.compiled = ctypes.CDLL(str(path)).rollout

    def __call__(
        self,
        thetas: Sequence[Array],
        start: Array,
        model: EmpiricalModel,
        picks: NDArray[np.int32],
    ) -> list[RolloutSamples]:
        """Run each θ. The compiled rollouts of several run at once, in threads.

        Where the QP fails the last action is repeated.

        Args:
            thetas: (n_θ,) each.
            start: state, (n,).
            model: plays the plant.
            picks: which of the model's residuals each sample meets, (T,).

        Returns:
            The samples of each θ, fewer than T where a state is not finite.
        """

        def one(theta: Array) -> RolloutSamples:
            if self.compiled is None:
                return self._interpreted(theta, start, model, picks)
            return self._compiled(theta, start, model, picks)

        # CasADi's functions are not for several threads; compiled ones are.
        with ThreadPoolExecutor(1 if self.compiled is None else None) as pool:
            return list(pool.map(one, thetas))

    def _compiled(
        self,
        theta: Array,
        start: Array,
        model: EmpiricalModel,
        picks: NDArray[np.int32],
    ) -> RolloutSamples:
        """One rollout in C (`rollout.c`)."""
        steps = len(picks)
        inputs = np.empty((steps, self._features.n_inputs))
        predicted = np.empty((steps, self._features.n_outputs))
        h = np.empty((steps, self._features.n_outputs))
        c, W = model.coefficients
        # C reads rows, one after the other.
        arguments = []
        for array in (theta, start, c, W, model.residuals, picks):
            arguments.append(np.ascontiguousarray(array))
        assert self.compiled is not None
        done = self.compiled(*pointers(*arguments), steps, *pointers(inputs, predicted, h))
        return RolloutSamples(inputs[:done], predicted[:done], h[:done])

    def _interpreted(
        self,
        theta: Array,
        start: Array,
        model: EmpiricalModel,
        picks: NDArray[np.int32],
    ) -> RolloutSamples:
        """The same in Python."""
        problem = self._problem
        controller = self._controller
        steps = len(picks)
        inputs = np.empty((steps, self._features.n_inputs))
        predicted = np.empty((steps, self._features.n_outputs))
        h = np.empty((steps, self._features.n_outputs))
        c, W = model.coefficients
        controller.theta = theta
        controller.reset()
        s = start
        a = problem.reference_action
        with np.errstate(over="ignore", invalid="ignore"):  # of a loop that runs away
            for step, pick in enumerate(picks):
                if not np.isfinite(s).all():
                    return RolloutSamples(inputs[:step], predicted[:step], h[:step])
                try:
                    controller.prepare()
                    wanted = controller.feedback(s).action
                    a = np.clip(wanted, problem.action_lower, problem.action_upper)
                except Exception as error:
                    recover(controller, error)
                # As in C: the prediction first, the residual makes the next state.
                inputs[step] = np.concatenate([s, a])
                y, size = self._features.mean(s, a, c)
                predicted[step] = y.full()[:, 0] + W @ np.append(1.0, inputs[step])
                h[step] = size.full()[:, 0]
                outcome = predicted[step] + h[step] * model.residuals[pick]
                s = outcome[:-1]
        return RolloutSamples(inputs, predicted, h)
