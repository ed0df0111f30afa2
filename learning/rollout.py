"""Rollouts: the RTI-NMPC of a problem in closed loop with an empirical model."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.resources import files
from math import nan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from controllers.export.core import ENGINE_SOURCES, core
from controllers.functions import c_source, library, not_in_c, work_sizes
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.protocols import Array, Step
from cosim.core.simulation import ClosedLoop
from learning.empirical_model import EmpiricalModel, Features, c_definitions, pointers
from learning.known_signals import SignalsOfSamples


class RolloutSamples(NamedTuple):
    """The samples of a rollout, T of them.

    Attributes:
        inputs: (s, a, v), (T, n+m+n_v).
        predicted: (s₊, ℓ) without residual, with what persists of the error before, (T, K).
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
        # At each sample the controller is told the values of all stages.
        known_counts = [problem.horizon + 1] * len(problem.varying)
        if features.n_signals:
            sizes["N_SIGNALS"] = features.n_signals
        sources: dict[str, str | bytes] = {
            **core(problem, parameters, known_counts=known_counts).sources,
            "sizes.h": c_definitions(sizes),
            # Where a function says that it is exported, Windows exports no other.
            "nominal.c": "#define CASADI_SYMBOL_EXPORT\n" + c_source([function]),
            "loop.h": (ENGINE_SOURCES / "loop.h").read_bytes(),
            "rti_loop.h": (ENGINE_SOURCES / "rti_loop.h").read_bytes(),
            "rollout.c": (files("learning") / "rollout.c").read_bytes(),
        }
        path = library(sources)
        if path is not None:
            compiled = ctypes.CDLL(str(path))
            self.compiled = compiled.rollout
            self._n_columns = int(compiled.rollout_columns())

    def __call__(
        self,
        thetas: Sequence[Array],
        start: Array,
        model: EmpiricalModel,
        picks: NDArray[np.int32],
        signals: SignalsOfSamples | None = None,
    ) -> list[RolloutSamples]:
        """Run each θ. The compiled rollouts of several run at once, in threads.

        Where the QP fails the last action is repeated.

        Args:
            thetas: (n_θ,) each.
            start: state, (n,).
            model: plays the plant.
            picks: which of the model's residuals each sample meets, (T,).
            signals: what each sample meets of the problem's signals; None without any.

        Returns:
            The samples of each θ, fewer than T where a state is not finite.
        """
        n_stages = self._problem.horizon + 1
        stages = np.empty((len(picks), n_stages, 0))
        inputs = np.empty((len(picks), 0))
        if signals is not None:
            stages = signals.stages
            inputs = signals.inputs

        def one(theta: Array) -> RolloutSamples:
            if self.compiled is None:
                return self._interpreted(theta, start, model, picks, stages, inputs)
            return self._compiled(theta, start, model, picks, stages, inputs)

        # CasADi's functions are not for several threads; compiled ones are.
        n_threads = 1 if self.compiled is None else None
        with ThreadPoolExecutor(n_threads) as pool:
            return list(pool.map(one, thetas))

    def _compiled(
        self,
        theta: Array,
        start: Array,
        model: EmpiricalModel,
        picks: NDArray[np.int32],
        stages: Array,
        signals: Array,
    ) -> RolloutSamples:
        """One rollout in C (`rollout.c`)."""
        features = self._features
        n_samples = len(picks)
        c, W = model.coefficients
        # C reads rows, one after the other.
        arrays = [theta, start, c, W, model.persistence, model.residuals, picks, stages, signals]
        in_rows = [np.ascontiguousarray(array) for array in arrays]
        arguments = pointers(*in_rows)
        table = np.empty((n_samples, self._n_columns))
        assert self.compiled is not None
        done = self.compiled(*arguments, n_samples, *pointers(table))
        # A row is the one of every closed loop: state and action, the plant's outputs, and more.
        n_loop = features.n_inputs - features.n_signals
        sizes = [n_loop, features.n_outputs, features.n_outputs]
        ends = np.cumsum(sizes)
        states_and_actions, predicted, h, _ = np.split(table[:done], ends, axis=1)
        inputs = np.concatenate([states_and_actions, signals[:done]], axis=1)
        # Copies: the table, whose other columns nobody reads, need not stay.
        return RolloutSamples(inputs, predicted.copy(), h.copy())

    def _interpreted(
        self,
        theta: Array,
        start: Array,
        model: EmpiricalModel,
        picks: NDArray[np.int32],
        stages: Array,
        signals: Array,
    ) -> RolloutSamples:
        """The same in Python."""
        plant = ModelledPlant(model, start, picks, signals)
        self._controller.theta = theta
        varying = self._problem.varying

        def known(k: int) -> dict[str, Array]:
            return {item.signal: stages[k, :, row] for row, item in enumerate(varying)}

        loop = ClosedLoop(plant.step, self._controller, self._problem, known=known)
        loop.start(start)
        n_samples = 0
        with np.errstate(over="ignore", invalid="ignore"):  # of a loop that runs away
            while n_samples < len(picks):
                if not np.isfinite(loop.s).all():
                    break
                loop.advance()
                n_samples += 1
        return RolloutSamples(
            inputs=plant.inputs[:n_samples],
            predicted=plant.predicted[:n_samples],
            h=plant.h[:n_samples],
        )


class ModelledPlant:
    """An empirical model as a plant, with a table of its samples.

    Args:
        model: plays the plant.
        start: state, (n,).
        picks: which of the model's residuals each sample meets, (T,).
        signals: what signals give of the model at each sample, v, (T, n_v).

    Attributes:
        inputs, predicted, h: rows of `RolloutSamples`, (T, …), filled so far as it has stepped.
    """

    def __init__(
        self,
        model: EmpiricalModel,
        start: Array,
        picks: NDArray[np.int32],
        signals: Array,
    ) -> None:
        features = model.features
        n_samples = len(picks)
        self._model = model
        self._c, self._W = model.coefficients
        self._picks = picks
        self._signals = signals
        self._s = start
        self._error = np.zeros(features.n_outputs)  # r of the sample before
        self._number = 0
        self.inputs = np.empty((n_samples, features.n_inputs))
        self.predicted = np.empty((n_samples, features.n_outputs))
        self.h = np.empty((n_samples, features.n_outputs))

    def step(self, a: Array) -> Step:
        """Hold the action a (m,) for one sampling time."""
        model = self._model
        number = self._number
        # As in C: the prediction first, the residual makes the next state.
        action_and_signals = np.concatenate([a, self._signals[number]])
        inputs = np.concatenate([self._s, action_and_signals])
        y, h_column = model.features.mean(self._s, action_and_signals, self._c)
        h = h_column.full()[:, 0]
        nominal = y.full()[:, 0]
        linear_part = self._W @ np.append(1.0, inputs)
        persists = model.persistence @ self._error
        predicted = nominal + linear_part + h * persists
        self.inputs[number] = inputs
        self.predicted[number] = predicted
        self.h[number] = h

        pick = self._picks[number]
        residual = model.residuals[pick]
        self._error = persists + residual
        outcome = predicted + h * residual
        self._s = outcome[:-1]
        stage_cost = float(outcome[-1])
        self._number = number + 1
        # The penalty is a matter of whoever reads the table.
        return Step(self._s, stage_cost, nan, residual)
