"""The data of a plant in operation, its regimes, and the empirical model of the present one.

A regime lies between two changes of the plant. Only its data count in the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from cosim.core.protocols import Array
from learning.algorithm import Transition
from learning.checkpoint import State, part_of, prefixed
from learning.empirical_model import EmpiricalModel, EmpiricalModelConfiguration, Features


class Predictions(NamedTuple):
    """Predictions of a model for T samples, and the outcomes.

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
        # A ring of transitions (s, a, v, s₊, ℓ), and of their numbers in the run.
        width = features.n_inputs + features.n_outputs
        self._rows = np.zeros((settings.memory, width))
        self._numbers = np.zeros(settings.memory, dtype=np.int64)
        self._earlier: EmpiricalModel | None = None  # from before the last change of the plant
        # Of the samples since the fit, a block for each `change_windows[0]` of them.
        self._blocks: list[Predictions] = []

    def add(self, transition: Transition, signals: Array | None = None) -> None:
        """Keep a transition in place of the oldest one.

        Args:
            transition: the transition.
            signals: what signals give of the model at its sample, v, (n_v,); None without any.
        """
        if signals is None:
            signals = np.empty(0)
        # Without the penalty, which is known: what is learned is smooth.
        stage_cost = np.array([transition.stage_cost])
        oldest = self.count % len(self._rows)
        self._rows[oldest] = np.concatenate(
            [
                transition.s,
                transition.a,
                signals,
                transition.next_s,
                stage_cost,
            ]
        )
        self._numbers[oldest] = transition.number
        self.count += 1

    def latest(self, count: int) -> tuple[Array, Array]:
        """Inputs (s, a, v) and outputs (s₊, ℓ) of so many of the latest samples, oldest first."""
        rows = self._rows[self._latest_places(count)]
        n_inputs = self.features.n_inputs
        return rows[:, :n_inputs], rows[:, n_inputs:]

    def latest_numbers(self, count: int) -> list[int]:
        """Numbers in the run of so many of the latest samples, oldest first."""
        numbers: list[int] = self._numbers[self._latest_places(count)].tolist()
        return numbers

    def _latest_places(self, count: int) -> NDArray[np.intp]:
        """Places in the ring of so many of the latest samples, oldest first."""
        size = len(self._rows)
        count = min(count, self.count, size)
        # The ring as time has it.
        samples = np.arange(self.count - count, self.count)
        return samples % size

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
            # The ring may have lost the first samples of the regime.
            first = self.count - len(inputs)
            self.regime_start = first + n_outdated
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
        settings = self.settings
        n_latest = len(inputs) // 4
        if n_latest < settings.forecast_samples:
            return 0
        n_older = (len(inputs) - n_latest) // 2
        with_older = slice(0, -n_latest)
        without = slice(n_older, -n_latest)
        models = []
        for part in (with_older, without):
            inputs_of_part = inputs[part]
            outputs_of_part = outputs[part]
            model = EmpiricalModel.fit(self.features, inputs_of_part, outputs_of_part, settings)
            models.append(model)
        # Both meet the noise of the newer model, and as many errors as are independent.
        newer = models[1]
        precision = np.linalg.pinv(newer.error_covariance)
        share = newer.effective_number(n_latest) / n_latest
        latest_inputs = inputs[-n_latest:]
        latest_outputs = outputs[-n_latest:]
        losses = []
        for model in models:
            errors = _compare(model, latest_inputs, latest_outputs).errors
            squares = float(np.einsum("mi,ij,mj->", errors, precision, errors))
            losses.append(share * squares / 2)
        loss_with_older, loss_without = losses
        evidence = loss_with_older - loss_without
        return n_older if evidence > settings.forecast_evidence else 0

    def predictions(self) -> Predictions:
        """Predictions of the samples since the fit, and their errors.

        Of as many of the latest ones as the longest window has, at most; a last part shorter than
        the shortest window is left out.
        """
        model = self.model
        assert model is not None
        windows = self.settings.change_windows
        block = windows[0]
        # Blocks that are known need not be predicted again.
        new = self.since_fit - block * len(self._blocks)
        # One more, if there is one: its error persists in part.
        inputs, outputs = self.latest(new + 1)
        count = len(inputs)
        first_new = count - new
        last_begin = count - block
        for first in range(first_new, last_begin + 1, block):
            part = slice(first, first + block)
            predictions = _compare(model, inputs[part], outputs[part])
            if first > 0 and model.persistence.any():
                # A prediction knows the error of the sample before, and what of it persists.
                before = slice(first - 1, first)
                error_before = _compare(model, inputs[before], outputs[before]).errors
                errors_before = np.concatenate([error_before, predictions.errors[:-1]])
                persisting = errors_before @ model.persistence.T
                outputs_of_block = predictions.outputs + predictions.h * persisting
                predictions = predictions._replace(outputs=outputs_of_block)
            self._blocks.append(predictions)
        n_latest = ceil(windows[-1] / block)
        latest = self._blocks[-n_latest:]
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
        # An output that no disturbance reaches is predicted to its rounding: an error as small as
        # that is improbable, and no change of the plant.
        _, outputs = self.present
        negligible = self.settings.smallest_change * outputs.std(axis=0)
        for window in self.settings.change_windows:
            if window > len(predictions.errors):
                break
            errors = predictions.errors[-window:]
            designs = predictions.designs[-window:]
            mean = errors.mean(axis=0)
            design = designs.mean(axis=0)
            # Of the mean's own noise and of what the model does not know.
            noise = model.mean_error_covariance(window)
            doubt = design @ model.covariance @ design.T
            size = predictions.h[-window:].mean(axis=0)
            indifference = np.diag((negligible / size) ** 2)
            squares = mean @ np.linalg.solve(noise + doubt + indifference, mean)
            # T² has an F distribution after this factor, of K and M − K degrees of freedom.
            scale = K * (M - 1)
            statistic = squares * (M - K) / scale
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
            "numbers": self._numbers,
            "count": self.count,
            "regime_start": self.regime_start,
            "changes": self.changes,
            "count_at_fit": self.count_at_fit,
        }
        if self.model is not None:
            state |= prefixed("model", self.model.state_dict())
        if self._earlier is not None:
            state |= prefixed("earlier", self._earlier.state_dict())
        return state

    def load_state_dict(self, state: State) -> None:
        """Restore what `state_dict` returned; predictions since the fit are made anew."""
        self._rows = state["rows"]
        self._numbers = state["numbers"]
        self.count = state["count"]
        self.regime_start = state["regime_start"]
        self.changes = state["changes"]
        self.count_at_fit = state["count_at_fit"]
        self._blocks = []
        self.model = self._restored(part_of(state, "model"))
        self._earlier = self._restored(part_of(state, "earlier"))

    def _restored(self, state: State) -> EmpiricalModel | None:
        """The model of this state; None before the first fit, or the first change."""
        if not state:
            return None
        return EmpiricalModel(self.features, **state)


def _compare(
    model: EmpiricalModel,
    inputs: Array,
    outputs: Array,
) -> Predictions:
    """Predictions of a model at inputs (T, n+m), beside what came of them, (T, K)."""
    predicted, h, designs = model.predict(inputs)
    errors = (outputs - predicted) / h
    return Predictions(predicted, h, errors, designs)
