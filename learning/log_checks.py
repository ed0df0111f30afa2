"""Selection of a log's samples for learning, and refusal of unfit logs.

Only the nominal model is asked. By its errors wrong columns, rows and units are found, impossible
readings, and the last change of the plant.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.core.logged_data import FEWEST, LoggedData, LoggedDataError
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario
from learning.empirical_model import INTEGRATION_ERROR, EmpiricalModelConfiguration, Features
from learning.log_configuration import LogConfiguration
from learning.plant_data import PlantData
from learning.prediction_errors import estimate_persistence


def usable(
    data: LoggedData,
    scenario: Scenario,
    features: Features,
    settings: EmpiricalModelConfiguration,
    log_settings: LogConfiguration,
) -> LoggedData:
    """The transitions that the nominal model can make sense of.

    Refused is a log that speaks for another reading of itself, or of which the model makes nothing;
    left out are jumps that no plant makes, and data from before a change of the plant.

    Args:
        data: the transitions.
        scenario: names the variables.
        features: the nominal model.
        settings: how many are remembered, and how a change is told.
        log_settings: how a doubtful log and a jump are told.

    Raises:
        LoggedDataError: the log is doubtful, or too little of it is left.
    """
    data = plausible(data, scenario, features, settings, log_settings)
    inputs, outputs = inputs_and_outputs(data, features)
    n_outdated = PlantData(features, settings).outdated(inputs, outputs)
    before_a_change = np.arange(len(data)) < n_outdated
    used = data.without(before_a_change, "before a change of the plant")
    # Fewer could not be parted in stretches: an interval would lack the disturbances' chance.
    if len(used) < FEWEST:
        counts = []
        for reason, count in used.left_out.items():
            counts.append(f"{reason}: {count}")
        raise LoggedDataError(
            f"{len(used)} transitions of the log can be used, and {FEWEST} are needed; left out "
            f"are {', '.join(counts) or 'none'}; log longer, or leave out less"
        )
    return used


def plausible(
    data: LoggedData,
    scenario: Scenario,
    features: Features,
    settings: EmpiricalModelConfiguration,
    log_settings: LogConfiguration,
) -> LoggedData:
    """The latest transitions without jumps that no plant makes; arguments are those of `usable`.

    Raises:
        LoggedDataError: the log speaks for another reading of itself, or the model makes nothing of
            it.
    """
    data = data.latest(settings.memory)
    _check_order(data, scenario, features, settings, log_settings)
    _check_units(data, scenario, features, log_settings)
    return data.without(_there_and_back(data, features, log_settings), "jump there and back")


def inputs_and_outputs(data: LoggedData, features: Features) -> tuple[Array, Array]:
    """A log's M transitions as the empirical model takes them.

    Args:
        data: the transitions.
        features: the nominal model, for a stage cost that is not logged.

    Returns:
        (s, a), (M, n+m), and (s₊, ℓ), (M, K).
    """
    inputs = np.column_stack([data.states, data.actions])
    stage_cost = data.stage_cost
    if stage_cost is None:
        stage_cost = _nominal_cost(inputs, features)
    outputs = np.column_stack([data.next_states, stage_cost])
    return inputs, outputs


def _nominal(features: Features, inputs: Array) -> tuple[Array, Array]:
    """Predictions of the nominal model at inputs (M, n+m), and the errors' sizes h, (M, K)."""
    no_errors = np.zeros(features.n_parameters)
    y, _, h = features(inputs, no_errors)
    return y, h


def _nominal_cost(inputs: Array, features: Features) -> Array:
    """The nominal model's stage cost with a little noise, (M,), at inputs (M, n+m)."""
    y, _ = _nominal(features, inputs)
    cost: Array = y[:, -1]
    # An output without any error has no size, and its rounding would look like one: this noise is
    # far above rounding, and a ten-thousandth of the cost.
    deviation = 1e-4 * float(np.abs(cost).mean())
    rng = np.random.default_rng(0)
    noise: Array = rng.standard_normal(len(cost))
    return cost + deviation * noise


class _Errors(NamedTuple):
    """Prediction errors of the nominal model at M transitions' states, over h.

    Attributes:
        errors: (M, n).
        rounding: their least deviations, (M, n).
    """

    errors: Array
    rounding: Array

    def centred(self) -> _Errors:
        """The same with errors of mean zero."""
        return self._replace(errors=self.errors - self.errors.mean(axis=0))

    @property
    def covariance(self) -> Array:
        """Of errors about zero, (n, n), each variance at least that of rounding."""
        least_variance = (self.rounding**2).mean(axis=0)
        covariance: Array = self.errors.T @ self.errors / len(self.errors)
        return covariance + np.diag(least_variance)

    def without_persistence(
        self, follows: NDArray[np.bool_], settings: EmpiricalModelConfiguration
    ) -> _Errors:
        """What the errors of the transition before do not say: r₊ - Φ r, of those that follow one.

        Args:
            follows: whether the transition before ends where this one begins, (M,).
            settings: when errors count as persistent.
        """
        later = np.flatnonzero(follows[1:]) + 1
        before = self.errors[later - 1]
        persistence = estimate_persistence(
            self.errors[later],
            before,
            np.zeros((self.errors.shape[1], self.errors.shape[1])),
            n_earlier=0,
            doubt=settings.persistence_doubt,
            largest=settings.largest_persistence,
        )
        return _Errors(self.errors[later] - before @ persistence.T, self.rounding[later])

    def log_likelihood(self) -> float:
        """Of normal errors of mean zero and unknown covariance, but for a constant."""
        count = len(self.errors)
        _, logarithm = np.linalg.slogdet(self.covariance)
        return float(-count * logarithm / 2)


class _Reading(NamedTuple):
    """M transitions as one reading of the log has them.

    Attributes:
        states: (M, n).
        actions: (M, m).
        next_states: (M, n).
    """

    states: Array
    actions: Array
    next_states: Array


def _errors_at(features: Features, reading: _Reading, c: Array) -> tuple[_Errors, Array]:
    """Errors of a model's states in a reading, and their derivatives by its parameters, (M, n, p).

    Args:
        features: the nominal model.
        reading: transitions.
        c: errors of the parameters, (p,).
    """
    n = reading.states.shape[1]
    inputs = np.column_stack([reading.states, reading.actions])
    y, G, h = features(inputs, c)
    sizes = h[:, :n]
    predicted = y[:, :n]
    errors = (reading.next_states - predicted) / sizes
    rounding = INTEGRATION_ERROR * np.abs(predicted) / sizes
    return _Errors(errors, rounding), G[:, :n] / sizes[:, :, None]


def _nominal_errors(features: Features, reading: _Reading) -> _Errors:
    """Errors of the nominal model's states."""
    errors, _ = _errors_at(features, reading, np.zeros(features.n_parameters))
    return errors


def _check_order(
    data: LoggedData,
    scenario: Scenario,
    features: Features,
    model_settings: EmpiricalModelConfiguration,
    settings: LogConfiguration,
) -> None:
    """Refuse a log whose inputs are a row off, or whose columns are exchanged.

    What is asked is whether the model explains the states better when the log is read otherwise. Of
    shifts it is the nominal model, since a fitted one would find the controller's own law in inputs
    of the next row. Of exchanged columns it is the model with its parameters fitted to each
    reading, too.
    """
    rows = _unbroken_rows(data, settings.largest_shift)
    if len(rows) < 10 * features.n_outputs:
        return
    as_it_is = _Reading(data.states[rows], data.actions[rows], data.next_states[rows])

    follows = np.diff(rows, prepend=-1) == 1

    def shifted_likelihood(shift: int) -> float:
        """Of the nominal model where the inputs are those of so many rows later."""
        shifted = as_it_is._replace(actions=data.actions[rows + shift])
        # A shift leaves the mean error as it is, which is the plant's own.
        errors = _nominal_errors(features, shifted).centred()
        # A feedback's inputs say what the errors were: where these persist, what comes.
        return errors.without_persistence(follows, model_settings).log_likelihood()

    gains = {}
    likelihood_as_logged = shifted_likelihood(0)
    for shift in _shifts(settings.largest_shift):
        gains[shift_in_words(shift)] = shifted_likelihood(shift) - likelihood_as_logged
    # Exchanged columns have another mean, and may make the model's states stand still: it counts.
    thinning = max(len(rows) // model_settings.fit_samples, 1)
    as_logged = _Reading(*(columns[::thinning] for columns in as_it_is))

    def likelihoods(reading: _Reading) -> tuple[float, float]:
        """Of the nominal model, and of the best of it and the fitted ones."""
        fits = [fit.log_likelihood() for fit in _fits(features, reading, model_settings)]
        return fits[0], max(fits)

    nominal_likelihood, best_likelihood = likelihoods(as_logged)

    def gain_of(reading: _Reading) -> float:
        """By how many nats the model explains this reading better than the log as it is.

        The least of the nominal model's and of the fitted one's: two inputs of nearly one size may
        undo an error of a parameter, and parameters that are fitted may explain a wrong unit.
        """
        nominal, best = likelihoods(reading)
        return min(nominal - nominal_likelihood, best - best_likelihood)

    plant = scenario.plant
    for one, other in combinations(range(len(plant.actions)), 2):
        words = f"columns {plant.actions[one]} and {plant.actions[other]} are exchanged"
        other_reading = as_logged._replace(actions=exchanged_columns(as_logged.actions, one, other))
        gains[words] = gain_of(other_reading)
    for one, other in combinations(range(len(plant.states)), 2):
        words = f"columns {plant.states[one]} and {plant.states[other]} are exchanged"
        other_reading = as_logged._replace(
            states=exchanged_columns(as_logged.states, one, other),
            next_states=exchanged_columns(as_logged.next_states, one, other),
        )
        gains[words] = gain_of(other_reading)
    refuse_misreading(gains, settings)


def refuse_misreading(
    gains: Mapping[str, float], settings: LogConfiguration, doubt: float = 0.0
) -> None:
    """Raise LoggedDataError where a log speaks for another reading of itself.

    Args:
        gains: nats by which it does, by the words for the mistake.
        settings: how many are too many.
        doubt: how many are not, in any case.
    """
    if not gains:
        return
    best = max(gains, key=lambda words: gains[words])
    if gains[best] > max(settings.misreading_evidence, doubt):
        raise LoggedDataError(
            f"the log looks as if {best}: the model then explains it better by "
            f"{gains[best]:.0f} nats; correct the file (a dead time of the plant belongs in the "
            "model)"
        )


def _fits(
    features: Features,
    reading: _Reading,
    settings: EmpiricalModelConfiguration,
) -> list[_Errors]:
    """Errors of the nominal model, and of those whose parameters are fitted to a reading.

    Args:
        features: the nominal model.
        reading: transitions.
        settings: prior of the parameters' errors, and the number of fits.
    """
    c: Array = np.zeros(features.n_parameters)
    precision = np.eye(len(c)) / settings.parameter_deviation**2
    largest = settings.largest_parameter_error
    nominal, design = _errors_at(features, reading, c)
    fits = [nominal]
    for _ in range(settings.fit_rounds - 1):
        # One Gauss-Newton step, each output weighted as it errs.
        target = fits[-1].errors + design @ c
        weighted = np.linalg.solve(fits[-1].covariance, design)
        normal = np.tensordot(weighted, design, axes=((0, 1), (0, 1)))
        moment = np.tensordot(weighted, target, axes=((0, 1), (0, 1)))
        solution = np.linalg.solve(normal + precision, moment)
        c = np.asarray(solution.clip(-largest, largest))
        fit, design = _errors_at(features, reading, c)
        fits.append(fit)
    return fits


def _unbroken_rows(data: LoggedData, reach: int) -> NDArray[np.intp]:
    """Rows of one unbroken stretch with so many before and behind them, whose inputs may shift."""
    middle = np.arange(reach, len(data) - reach)
    whole = np.ones(len(middle), bool)
    for shift in range(1 - reach, reach + 1):
        whole &= data.follows[middle + shift]
    return middle[whole]


def _shifts(largest: int) -> list[int]:
    """Shifts of the inputs that are looked for, in rows: early ones are negative."""
    shifts = []
    for shift in range(-largest, largest + 1):
        if shift != 0:
            shifts.append(shift)
    return shifts


def shift_in_words(shift: int) -> str:
    """Text about a shift of the inputs."""
    way = "late" if shift > 0 else "early"
    rows = "row" if abs(shift) == 1 else "rows"
    return f"the inputs are logged {abs(shift)} {rows} {way}"


def exchanged_columns(table: Array, one: int, other: int) -> Array:
    """A table (M, ·) with two columns exchanged."""
    exchanged = table.copy()
    exchanged[:, [one, other]] = table[:, [other, one]]
    return exchanged


def _check_units(
    data: LoggedData,
    scenario: Scenario,
    features: Features,
    settings: LogConfiguration,
) -> None:
    """Refuse a log whose states or stage cost are in another unit, or of another plant."""
    n = data.states.shape[1]
    y, h = _nominal(features, np.column_stack([data.states, data.actions]))
    sizes = h[:, :n]
    errors = (data.next_states - y[:, :n]) / sizes
    changes = (data.next_states - data.states) / sizes
    # "Nothing changes" is the poorest model; one that is far poorer has other units.
    for i, name in enumerate(scenario.plant.states):
        change = float(np.sqrt(np.mean(changes[:, i] ** 2)))
        if _is_unlike(errors[:, i], change, settings):
            raise LoggedDataError(
                f"the model predicts {name} more than {settings.largest_error_ratio:g} times worse "
                "than that it stays as it is: a unit or a column is wrong, or the model is of "
                "another plant"
            )
    if data.stage_cost is None:
        return
    stage_cost = data.stage_cost
    predicted_cost = y[:, -1]
    cost_sizes = h[:, -1]
    cost_errors = (stage_cost - predicted_cost) / cost_sizes
    spread = float(np.std(stage_cost / cost_sizes))
    if _is_unlike(cost_errors, spread, settings):
        raise LoggedDataError(
            f"the logged stage cost is {stage_cost.mean():.6g} on average, and the model's "
            f"{predicted_cost.mean():.6g}: another unit, or another cost? Without the column the "
            "model's is taken"
        )


def _is_unlike(errors: Array, spread: float, settings: LogConfiguration) -> bool:
    """Whether a model's errors say that it is of something else, or in another unit.

    Args:
        errors: over h, (M,).
        spread: root mean square of what they must be small against, over h.
        settings: how large they may be against that, and which mean they must have.
    """
    size = float(np.sqrt(np.mean(errors**2)))
    is_biased = abs(float(errors.mean())) > settings.least_bias
    return size > settings.largest_error_ratio * spread and is_biased


def _there_and_back(
    data: LoggedData,
    features: Features,
    settings: LogConfiguration,
) -> NDArray[np.bool_]:
    """Transitions of a reading that leaves the plant's and comes back, (M,): a spike, a dropout.

    A disturbance of the plant, be it as large, does not jump back by itself.
    """
    as_it_is = _Reading(data.states, data.actions, data.next_states)
    nominal = _nominal_errors(features, as_it_is)
    least_deviations = nominal.rounding.mean(axis=0)
    changes = data.next_states - data.states
    is_jump = np.zeros(len(data), bool)
    for i, least_deviation in enumerate(least_deviations.tolist()):
        jumps = jumps_there_and_back(
            nominal.errors[:, i], least_deviation, changes[:, i], data.follows, settings
        )
        for there, back in jumps:
            is_jump[there : back + 1] = True
    return is_jump


def jumps_there_and_back(
    errors: Array,
    least_deviation: float,
    changes: Array,
    follows: NDArray[np.bool_],
    settings: LogConfiguration,
) -> list[tuple[int, int]]:
    """Jumps of one quantity that are taken back: the number of each, and of the one back.

    Args:
        errors: of the model's predictions, (M,).
        least_deviation: of them.
        changes: of the quantity, (M,).
        follows: whether each change begins where the one before ends, (M,).
        settings: what a jump is.
    """
    distance = np.abs(errors - np.median(errors))
    # The median's deviation is not moved by the jumps themselves; of a normal law it is the
    # standard deviation over 1.4826.
    deviation = max(1.4826 * float(np.median(distance)), least_deviation)
    size = distance / max(deviation, np.finfo(np.float64).tiny)
    jumps = []
    for there in np.flatnonzero(size > settings.jump_size).tolist():
        back = _jump_back(there, size, changes, follows, settings)
        if back is not None:
            jumps.append((there, back))
    return jumps


def _jump_back(
    there: int,
    size: Array,
    change: Array,
    follows: NDArray[np.bool_],
    settings: LogConfiguration,
) -> int | None:
    """The transition in which a reading that has jumped comes back; None where it stays.

    Args:
        there: the transition of the jump.
        size: of the errors of this state, in deviations, (M,).
        change: of this state in each transition, (M,).
        follows: whether the transition before ends where this one begins, (M,).
        settings: how large a jump back is, and how soon it comes.
    """
    # A reading that stands still has not jumped, however the model errs.
    if change[there] == 0:
        return None
    largest = settings.largest_jump_ratio
    end = min(there + 1 + settings.longest_dropout, len(size))
    for later in range(there + 1, end):
        if not follows[later]:
            return None
        # The model expects the plant to stay where the jump has led, not to come back.
        if size[later] <= settings.return_size:
            continue
        ratio = -change[later] / change[there]
        if 1 / largest < ratio < largest:
            return later
    return None
