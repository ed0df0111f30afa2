"""The data of a plant in operation, its regimes, and the empirical model of the present one.

A regime lies between two changes of the plant. Only its data count in the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import fdtrc

from cosim.core.protocols import Array
from learning.algorithm import Transition
from learning.checkpoint import State, part_of, prefixed
from learning.empirical_model import EmpiricalModel, EmpiricalModelConfiguration, Features


class Predictions(NamedTuple):
    """What a model says of T samples, and what became of them.

    Attributes:
        outputs: predicted (s₊, ℓ) without residual, with what persists of the error before, (T, K).
        h: sizes of the errors, (T, K).
        errors: all of the prediction errors r, over h, (T, K).
        designs: derivative of the predictions by the model's coefficients over h, (T, K, q).
    """

    outputs: Array
    h: Array
    errors: Array
    designs: Array


class PlantData:
    """The latest transitions of a plant in operation, and the `model` of the plant as it is now.

    Args:
        features: the nominal model.
        settings: of model, memory and change detection.

    Attributes:
        count: samples so far.
        regime_start: samples before the present regime.
        changes: regimes before it.
        count_at_fit: samples at the last fit.
    """

    def __init__(self, features: Features, settings: EmpiricalModelConfiguration) -> None:
        self.features = features
        self.settings = settings
        self.model: EmpiricalModel | None = None
        self.count = 0
        self.regime_start = 0
        self.changes = 0
        self.count_at_fit = 0
        # A ring of transitions (s, a, s₊, ℓ).
        self._rows = np.zeros((settings.memory, features.n_inputs + features.n_outputs))
        self._earlier: EmpiricalModel | None = None  # from before the last change of the plant
        # Of the samples since the fit, a block for each `change_windows[0]` of them.
        self._blocks: list[Predictions] = []

    def add(self, transition: Transition) -> None:
        """Keep a transition in place of the oldest one."""
        stage_cost = np.array([transition.stage_cost])
        row = [transition.s, transition.a, transition.next_s, stage_cost]
        self._rows[self.count % len(self._rows)] = np.concatenate(row)
        self.count += 1

    def latest(self, count: int) -> tuple[Array, Array]:
        """Inputs (s, a) and outputs (s₊, ℓ) of so many of the latest samples, oldest first."""
        count = min(count, self.count, len(self._rows))
        # The ring as time has it.
        where = np.arange(self.count - count, self.count) % len(self._rows)
        rows = self._rows[where]
        return rows[:, : self.features.n_inputs], rows[:, self.features.n_inputs :]

    @property
    def age(self) -> int:
        """Samples of the present regime."""
        return self.count - self.regime_start

    @property
    def since_fit(self) -> int:
        """Samples since the last fit."""
        return self.count - self.count_at_fit

    @property
    def present(self) -> tuple[Array, Array]:
        """Inputs and outputs of the present regime."""
        return self.latest(self.age)

    def fit(self) -> EmpiricalModel:
        """Fit the model to the plant as it is now; data that spoil its predictions are dropped."""
        inputs, outputs = self.present
        n_outdated = self.outdated(inputs, outputs)
        if n_outdated:
            self.regime_start = self.count - len(inputs) + n_outdated
            inputs, outputs = self.present
        # Residuals from before a change fill up those of a young regime.
        room = max(self.settings.earlier_residuals - len(inputs), 0)
        earlier = self._earlier
        if earlier is not None:
            earlier = replace(earlier, residuals=earlier.residuals[:room])
        model = EmpiricalModel.fit(self.features, inputs, outputs, self.settings, earlier)
        self.model = model
        self.count_at_fit = self.count
        self._blocks = []
        return model

    def outdated(self, inputs: Array, outputs: Array) -> int:
        """Number of oldest samples without which the model predicts the latest quarter better.

        Args:
            inputs: (s, a), (M, n+m), oldest first.
            outputs: (s₊, ℓ), (M, K).
        """
        # Too few samples say nothing about older ones.
        n_latest = len(inputs) // 4
        if n_latest < self.settings.forecast_samples:
            return 0
        n_older = (len(inputs) - n_latest) // 2
        models = []
        for first in (0, n_older):
            part = slice(first, -n_latest)
            models.append(
                EmpiricalModel.fit(self.features, inputs[part], outputs[part], self.settings)
            )
        # Both are judged by the noise of the newer model, and by as many errors as are independent.
        precision = np.linalg.pinv(models[1].error_covariance)
        share = models[1].effective_number(n_latest) / n_latest
        losses = []
        for model in models:
            predicted, h, _ = model.predict(inputs[-n_latest:])
            errors = (outputs[-n_latest:] - predicted) / h
            squares = float(np.einsum("mi,ij,mj->", errors, precision, errors))
            losses.append(share * squares / 2)
        evidence = losses[0] - losses[1]
        return n_older if evidence > self.settings.forecast_evidence else 0

    def predictions(self) -> Predictions:
        """Predictions of the samples since the fit, and their errors.

        Of as many of the latest ones as the longest window has, at most; a last part shorter than
        the shortest window is left out.
        """
        assert self.model is not None
        windows = self.settings.change_windows
        block = windows[0]
        # Blocks that are known need not be predicted again.
        new = self.since_fit - block * len(self._blocks)
        # One more, if there is one: its error persists in part.
        inputs, outputs = self.latest(new + 1)
        for first in range(len(inputs) - new, len(inputs) - block + 1, block):
            part = slice(first, first + block)
            predicted, h, designs = self.model.predict(inputs[part])
            errors = (outputs[part] - predicted) / h
            if first > 0 and self.model.persistence.any():
                before = slice(first - 1, first)
                predicted_before, h_before, _ = self.model.predict(inputs[before])
                error_before = (outputs[before] - predicted_before) / h_before
                errors_before = np.concatenate([error_before, errors[:-1]])
                predicted = predicted + h * (errors_before @ self.model.persistence.T)
            self._blocks.append(Predictions(predicted, h, errors, designs))
        latest = self._blocks[-windows[-1] // block :]
        columns = [np.concatenate(column) for column in zip(*latest, strict=True)]
        return Predictions(*columns)

    def changed(self, predictions: Predictions, suspect: Sequence[int] = ()) -> bool:
        """Whether the mean prediction error of a window is improbable (Hotelling's T²).

        A new regime begins with that window then.

        Args:
            predictions: of the latest samples.
            suspect: windows in which a less improbable mean is enough.
        """
        model = self.model
        assert model is not None
        K = self.features.n_outputs
        M = model.effective_number(len(model.residuals))
        # So few independent errors say nothing of their own size.
        if M <= K + 1:
            return False
        for window in self.settings.change_windows:
            if window > len(predictions.errors):
                break
            mean = predictions.errors[-window:].mean(axis=0)
            design = predictions.designs[-window:].mean(axis=0)
            covariance = model.mean_error_covariance(window)
            covariance = covariance + design @ model.covariance @ design.T
            # Hotelling's T², of the mean's own noise and of what the model does not know.
            statistic = mean @ np.linalg.solve(covariance, mean) * (M - K) / (K * (M - 1))
            probability = fdtrc(K, M - K, max(statistic, 0.0))
            limit = self.settings.change_probability
            if window in suspect:
                limit = self.settings.suspicion_probability
            if probability < limit:
                # Samples before the window are of another plant; its residuals are kept.
                self.changes += 1
                self.regime_start = self.count - window
                latest = model.residuals[-self.settings.earlier_residuals :]
                self._earlier = replace(model, residuals=latest)
                return True
        return False

    def state_dict(self) -> State:
        """The transitions, the regime and the model."""
        state: State = {
            "rows": self._rows,
            "count": self.count,
            "regime_start": self.regime_start,
            "changes": self.changes,
            "count_at_fit": self.count_at_fit,
        }
        for name, model in (("model", self.model), ("earlier", self._earlier)):
            if model is not None:
                state |= prefixed(name, model.state_dict())
        return state

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned; predictions since the fit are made anew."""
        self._rows = state["rows"]
        self.count = state["count"]
        self.regime_start = state["regime_start"]
        self.changes = state["changes"]
        self.count_at_fit = state["count_at_fit"]
        self._blocks = []
        # Before the first fit there is no model, before the first change no earlier one.
        model = part_of(state, "model")
        self.model = EmpiricalModel(self.features, **model) if model else None
        earlier = part_of(state, "earlier")
        self._earlier = EmpiricalModel(self.features, **earlier) if earlier else None
