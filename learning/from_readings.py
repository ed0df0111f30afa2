"""θ from a log of readings, where the states themselves were not measured.

Filter and plant are fitted to the readings as `model-based` does it in operation
(`learning.model_from_outputs`), and θ is what its search finds on that plant. What a θ costs is
predicted on plants drawn from the posterior: the variances of the noises by Laplace's
approximation, the uncertain parameters by the filter's covariance. What the logged operation has
cost, no sensor shows either: it is the filter's estimate, the penalty by its expectation.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.errors import ModelWarning
from controllers.estimator import ExtendedKalmanFilter
from controllers.factories import nmpc
from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.core.errors import warn
from cosim.core.logged_data import LoggedDataError
from cosim.core.logged_readings import LoggedReadings
from cosim.core.protocols import Array, Vector
from learning.exploration import Strategy
from learning.gaussian_penalty import expected_penalties_with_errors
from learning.innovations import REACH, Stretch, noise_covariance
from learning.log_answer import (
    Known,
    KnownParameter,
    TrainingFromData,
    differences_of,
    directions_of,
    excitation,
    is_same_cost,
    moved_bounds,
    moves_of,
)
from learning.log_checks import (
    exchanged_columns,
    jumps_there_and_back,
    refuse_misreading,
    shift_in_words,
)
from learning.log_configuration import LogConfiguration
from learning.log_prediction import difference_of_separate
from learning.model_from_outputs import MEND_OF_BIAS, FilteredRollout, FittedPlant, ModelFromOutputs
from learning.training_run import TrainingRun

FEWEST_INNOVATIONS = 20
"""Readings of a sensor below which the spread of its innovations says nothing."""
LEAST_NORMAL_SHARE = 1e-6
"""Of the search's weight of the normal law: above zero for a state of which no error was seen."""
MOST_ERRORS = 400
"""Innovations of a sensor over which a penalty is expected."""


class Followed(NamedTuple):
    """M samples of a log as a filter follows them.

    Attributes:
        means: of the states, predicted before a sample's readings are taken up, (M, n).
        variances: of the errors of these, (M, n).
        estimates: of the states, with the readings, (M, n).
        innovations: of the sensors, over their expected deviations, (M, n_y).
    """

    means: Array
    variances: Array
    estimates: Array
    innovations: Array


def follow(estimator: ExtendedKalmanFilter, stretches: Sequence[Stretch]) -> Followed:
    """A log as a filter follows it; each stretch it begins anew.

    Args:
        estimator: the filter; it ends at the log's last sample.
        stretches: the log.
    """
    rows: tuple[list[Vector], ...] = ([], [], [], [])
    means, variances, estimates, innovations = rows
    for readings, actions in stretches:
        estimator.reset()
        for k, y in enumerate(readings):
            # The reset filter stands before the first reading already.
            if k > 0:
                estimator.predict(actions[k - 1])
            means.append(estimator.estimate)
            variances.append(estimator.covariance.diagonal())
            estimates.append(estimator.correct(y))
            innovations.append(estimator.standardised.copy())
    return Followed(*(np.array(column) for column in rows))


class _Fit(NamedTuple):
    """`model-based` under sensors, fitted to a log.

    Attributes:
        rule: has filter, fitted plant and search; its filter stands at the log's last sample.
        data: the rows that are used.
        stretches: these, for the filter.
        noise: η that fits them, (q,).
        covariance: of η, (q, q).
        followed: the log as the filter follows it with that.
    """

    rule: ModelFromOutputs
    data: LoggedReadings
    stretches: list[Stretch]
    noise: Vector
    covariance: Array
    followed: Followed


def train_from_readings(
    run: TrainingRun,
    log_settings: LogConfiguration,
    data: LoggedReadings,
) -> TrainingFromData:
    """Fit filter and plant, propose θ, and predict what it costs.

    Args:
        run: of `model-based`, on a scenario with sensors.
        log_settings: what of the log is refused, left out or believed.
        data: the log.

    Raises:
        LoggedDataError: the log is doubtful.
        ConfigurationError: the scenario has no filter whose variances can be fitted.
    """
    scenario = run.scenario
    problem = Problem.from_scenario(scenario)
    start = run.starting_parameters()
    rng = np.random.default_rng(run.seed)
    rule = ModelFromOutputs(
        nmpc(scenario, start, run.controller),
        scenario,
        run.configuration,
        run.samples,
        Strategy(run.configuration, scenario),
        rng,
    )
    fit = _fit(rule, data, log_settings)
    known = _known(fit, problem)

    rule.errors = _errors(rule, fit.followed.innovations)
    may_shrink = len(fit.data) >= rule.configuration.shrink_samples
    learned, cost = rule.search(fit.noise, may_shrink=may_shrink)
    status = "finished"
    if not np.isfinite(cost.mean):
        status = "diverged: the plant that fits the log runs away with every θ of the search"
        learned = start

    moved = moved_bounds(learned, problem, cost.deviation)
    thetas = [learned, start, *(one.theta for one in moved)]
    costs = _predicted_costs(fit, thetas, log_settings.drawn_models, rng)
    of_learned, of_start, *of_moved = costs.thetas
    parts = log_settings.stretches
    shown = differences_of(of_learned, of_start, costs.logged, parts, difference_of_separate)
    return TrainingFromData(
        run=run,
        log_settings=log_settings,
        data=fit.data,
        start=start,
        learned=learned,
        status=status,
        logged_cost=float(costs.logged.mean()),
        modelled_cost=float(costs.logged_by_model.mean()),
        start_cost=float(of_start.mean()),
        learned_cost=float(of_learned.mean()),
        **shown._asdict(),
        known=known,
        moves=moves_of(moved, of_moved, of_learned, parts),
        excitation=excitation(fit.followed.estimates, fit.data.actions, scenario),
        cost_is_modelled=fit.data.stage_cost is None,
        outside=costs.outside,
    )


def _fit(rule: ModelFromOutputs, data: LoggedReadings, settings: LogConfiguration) -> _Fit:
    """Fit the filter to a log; raises LoggedDataError where that is doubtful."""
    data = data.latest(rule.configuration.output_samples)
    data = _without_jumps(rule, data, settings)
    stretches = _stretches(data.readings, data.actions, data)
    noise, innovations = rule.fit_filter(stretches)
    biased = rule.biased_sensors(innovations)
    if biased:
        raise LoggedDataError(
            f"the readings of {', '.join(biased)} are off the model's for good, which no noise "
            f"explains: another unit, or another variable? Else {MEND_OF_BIAS}"
        )
    _check_order(rule, data, innovations, settings)
    _warn_of_persistence(rule, innovations, settings)
    _warn_of_noise(rule, noise)
    covariance = noise_covariance(
        rule.filter, stretches, rule.prior_mean, rule.configuration.noise_prior
    )
    # The filter ends where the log does.
    followed = follow(rule.filter, stretches)
    return _Fit(rule, data, stretches, noise, covariance, followed)


def _stretches(readings: Array, actions: Array, data: LoggedReadings) -> list[Stretch]:
    """Readings (M, n_y) and actions (M, m) of a log, parted where the log is."""
    stretches = []
    for rows in data.stretches:
        stretches.append(Stretch(readings[rows], actions[rows]))
    return stretches


def _without_jumps(
    rule: ModelFromOutputs,
    data: LoggedReadings,
    settings: LogConfiguration,
) -> LoggedReadings:
    """The log without readings that leave the plant's and come back: spikes and dropouts."""
    stretches = _stretches(data.readings, data.actions, data)
    innovations = follow(rule.filter, stretches).innovations
    stretch_of_row = np.cumsum(data.begins)
    for i, sensor in enumerate(rule.scenario.sensors or ()):
        arrived = np.flatnonzero(~np.isnan(data.readings[:, i]))
        if len(arrived) < FEWEST_INNOVATIONS:
            continue
        values = data.readings[arrived, i]
        follows = np.diff(stretch_of_row[arrived], prepend=0) == 0
        # A reading's change is that from the one before.
        changes = np.diff(values, prepend=values[0])
        jumps = jumps_there_and_back(innovations[arrived, i], 0.0, changes, follows, settings)
        doubtful = np.zeros(data.readings.shape, bool)
        for there, back in jumps:
            # The reading that comes back is the plant's own.
            doubtful[arrived[there:back], i] = True
        data = data.without_readings(doubtful, f"{sensor.variable} jumps there and back")
    return data


def _check_order(
    rule: ModelFromOutputs,
    data: LoggedReadings,
    as_it_is: Array,
    settings: LogConfiguration,
) -> None:
    """Refuse a log whose inputs are a row early, or whose columns are exchanged.

    What is asked is how much smaller the innovations are when the log is read otherwise, with the
    variances that fit it as it is. Of a shift it is asked without what persists of them: a
    feedback's inputs say what the errors were, and so, where these persist, what comes. Inputs
    that are a row late cannot be told: a feedback's next input is made of the very reading that
    is predicted.

    Args:
        rule: has the filter.
        data: the log.
        as_it_is: its innovations, (M, n_y).
        settings: from when on the log is doubtful.
    """
    actions = rule.scenario.plant.actions
    sensors = [sensor.variable for sensor in rule.scenario.sensors or ()]
    # One without derivatives, which is faster.
    estimator = ExtendedKalmanFilter.from_scenario(rule.scenario)
    estimator.noise = rule.filter.noise
    estimator.compile()
    white = _white(as_it_is)
    gains = {}
    for shift in range(-settings.largest_shift, 0):
        # The few rows at the ends of stretches that meet others' inputs do not decide.
        shifted = np.roll(data.actions, -shift, axis=0)
        followed = follow(estimator, _stretches(data.readings, shifted, data))
        gains[shift_in_words(shift)] = _nats(_white(followed.innovations), white)
    for one, other in combinations(range(len(actions)), 2):
        words = f"columns {actions[one]} and {actions[other]} are exchanged"
        exchanged = exchanged_columns(data.actions, one, other)
        followed = follow(estimator, _stretches(data.readings, exchanged, data))
        gains[words] = _nats(followed.innovations, as_it_is)
    for one, other in combinations(range(len(sensors)), 2):
        words = f"columns {sensors[one]} and {sensors[other]} are exchanged"
        exchanged = exchanged_columns(data.readings, one, other)
        followed = follow(estimator, _stretches(exchanged, data.actions, data))
        gains[words] = _nats(followed.innovations, as_it_is)
    # A filter that is off a little is so at each reading.
    n_readings = int((~np.isnan(as_it_is)).sum())
    refuse_misreading(gains, settings, settings.misreading_share * n_readings)


def _warn_of_persistence(
    rule: ModelFromOutputs, innovations: Array, settings: LogConfiguration
) -> None:
    """Warn where innovations follow one another: what the model lacks, no interval holds."""
    names = []
    for sensor, values in zip(rule.scenario.sensors or (), innovations.T, strict=True):
        arrived = values[~np.isnan(values)]
        if len(arrived) < FEWEST_INNOVATIONS:
            continue
        if abs(_persistence(arrived - arrived.mean())) > settings.persistent_innovations:
            names.append(sensor.variable)
    if names:
        warn(
            f"the errors in predicting {', '.join(names)} follow one another: the model lacks "
            "something, or disturbances last. Of states that no sensor shows its predictions may "
            "be off by more than their intervals: mend the model (`cosim fmu check FMU --model "
            "MODEL`) or add a sensor",
            ModelWarning,
        )


def _warn_of_noise(rule: ModelFromOutputs, noise: Vector) -> None:
    """Warn where a noise's deviation would be larger than the fit may make it."""
    most = REACH * rule.configuration.noise_prior
    away = noise - rule.prior_mean
    for label, of_one in zip(rule.filter.noise_labels, away.tolist(), strict=True):
        if of_one > 0.999 * most:
            warn(
                f"the log shows a deviation of {label} of {np.exp(most / 2):.2g} times what is "
                "expected, or more: costs that are predicted with it are too low; state it in the "
                "scenario ([estimator] disturbance_deviation or sensor_deviation)",
                ModelWarning,
            )


def _persistence(values: Array) -> float:
    """Share of each value, (M,) of mean zero, that the one before says."""
    before = values[:-1]
    later = values[1:]
    return float(before @ later) / float(before @ before)


def _nats(innovations: Array, as_it_is: Array) -> float:
    """By how many nats innovations (M, n_y) speak for another reading than the log as it is."""
    total = 0.0
    for other, own in zip(innovations.T, as_it_is.T, strict=True):
        arrived = own[~np.isnan(own)]
        # A sensor with few readings says nothing.
        if len(arrived) < FEWEST_INNOVATIONS:
            continue
        ratio = np.nanmean(arrived**2) / np.nanmean(other**2)
        total += len(arrived) * float(np.log(ratio)) / 2
    return total


def _white(innovations: Array) -> Array:
    """Innovations (M, n_y) without their mean and what each sensor's last one says of the next."""
    white = np.full_like(innovations, np.nan)
    for i, values in enumerate(innovations.T):
        arrived = np.flatnonzero(~np.isnan(values))
        if len(arrived) < FEWEST_INNOVATIONS:
            continue
        centred = values[arrived] - values[arrived].mean()
        white[arrived[1:], i] = centred[1:] - _persistence(centred) * centred[:-1]
    return white


class _Costs(NamedTuple):
    """Costs that D drawn plants predict.

    Attributes:
        thetas: of each θ at T samples of a rollout, (D, T) each; infinite where one is lost.
        logged: of the logged operation at its M rows, (D, M).
        logged_by_model: the same, with the model's stage cost.
        outside: share of the first θ's samples in which a state is where the plant has not been.
    """

    thetas: list[Array]
    logged: Array
    logged_by_model: Array
    outside: float


def _predicted_costs(
    fit: _Fit,
    thetas: Sequence[Parameters],
    count: int,
    rng: np.random.Generator,
) -> _Costs:
    """What θ and the logged operation cost by so many plants drawn from the posterior."""
    rule = fit.rule
    settings = rule.configuration
    data = fit.data
    by_model = _stage_costs(rule, fit.followed.estimates, data.actions)
    stage_costs = by_model if data.stage_cost is None else data.stage_cost
    plant = FittedPlant(rule.scenario, thetas[0], settings.normal_errors)
    # All plants and all θ meet the same noise.
    seed = int(rng.integers(2**63))
    n_samples = settings.coarse_rollout
    costs = []
    for _ in thetas:
        costs.append(np.full((count, n_samples - settings.burn_in), np.inf))
    penalties = np.empty((count, len(data)))
    outside = []
    # A θ that differs from the first one by a bound out of reach, which costs the same.
    alike = set()
    for number in range(count):
        rule.filter.noise = rng.multivariate_normal(fit.noise, fit.covariance)
        followed = follow(rule.filter, fit.stretches)
        errors = _errors(rule, followed.innovations, rng)
        # How long the tails are, few errors do not say: between those seen and the search's law.
        plant.n_normal = settings.normal_errors * rng.uniform(LEAST_NORMAL_SHARE, 1.0)
        by_bound = expected_penalties_with_errors(
            rule.scenario.state_penalty,
            followed.means,
            followed.variances,
            errors,
            plant.n_normal,
        )
        penalties[number] = by_bound.sum(axis=0)
        parameters = _drawn_parameters(rule.filter, rng)
        plant.fit(rule.filter, parameters, errors, seed)
        for place, theta in enumerate(thetas):
            if place in alike:
                costs[place][number] = costs[0][number]
                continue
            rollout = plant.rollout(theta, n_samples, settings.burn_in, theta["noise"])
            if rollout is None:
                continue
            costs[place][number] = rollout.costs + rollout.penalties.sum(axis=0)
            if place == 0:
                outside.append(_share_outside(rollout, followed.estimates))
            elif number == 0 and is_same_cost(costs[place][0], costs[0][0]):
                alike.add(place)
    return _Costs(
        thetas=costs,
        logged=stage_costs + penalties,
        logged_by_model=by_model + penalties,
        outside=float(np.mean(outside)) if outside else 1.0,
    )


def _drawn_parameters(
    estimator: ExtendedKalmanFilter, rng: np.random.Generator
) -> dict[str, float]:
    """The uncertain parameters as they may be at a filter's last sample."""
    parameters = estimator.parameters
    if not parameters:
        return {}
    mean = list(parameters.values())
    drawn = rng.multivariate_normal(mean, estimator.parameter_covariance)
    return dict(zip(parameters, drawn.tolist(), strict=True))


def _stage_costs(rule: ModelFromOutputs, states: Array, actions: Array) -> Array:
    """The model's stage costs at states (M, n) and actions (M, m), without disturbance, (M,)."""
    model = Problem.from_scenario(rule.scenario).model
    x, u, d, p = model.symbols()
    cost = ca.Function("cost", [x, u, d, p], [ca.SX(model.economic_cost(x, u, d, p))])
    parameters = model.nominal_parameters
    for name, value in rule.filter.parameters.items():
        parameters[model.parameter_indices((name,))] = value
    costs: Array = cost(states.T, actions.T, model.nominal_disturbance, parameters).full()[0]
    return costs


def _errors(
    rule: ModelFromOutputs, innovations: Array, rng: np.random.Generator | None = None
) -> list[Array]:
    """Innovations of each state's sensor, at most `MOST_ERRORS` of each.

    Args:
        rule: knows the sensors.
        innovations: (M, n_y).
        rng: draws them with replacement, as another log of this length might show them (a
            bootstrap): a penalty hangs on few. None: evenly taken.
    """
    errors = []
    for of_state in rule.errors_of_states(innovations):
        count = len(of_state)
        if rng is not None and count:
            errors.append(rng.choice(of_state, min(count, MOST_ERRORS)))
        else:
            errors.append(of_state[:: max(count // MOST_ERRORS, 1)])
    return errors


def _share_outside(rollout: FilteredRollout, estimates: Array) -> float:
    """Share of a rollout's samples in which a state is where no estimate of the log was."""
    low = estimates.min(axis=0)
    high = estimates.max(axis=0)
    is_outside: NDArray[np.bool_] = (rollout.means < low) | (rollout.means > high)
    return float(is_outside.any(axis=1).mean())


def _known(fit: _Fit, problem: Problem) -> Known:
    """What the log says of the uncertain parameters and of the noises' deviations.

    The error of a deviation is that of its logarithm.
    """
    estimator = fit.rule.filter
    parameters = estimator.parameters
    after = estimator.parameter_covariance
    before = estimator.initial_parameter_deviation
    width = fit.rule.configuration.noise_prior
    n_parameters = len(parameters)
    n = n_parameters + fit.noise.size
    # Parameters and variances are independent in the filter.
    left = np.zeros((n, n))
    left[:n_parameters, :n_parameters] = after / np.outer(before, before)
    left[n_parameters:, n_parameters:] = fit.covariance / width**2

    known = []
    for i, (name, value) in enumerate(parameters.items()):
        (place,) = problem.model.parameter_indices((name,))
        nominal = float(problem.model.nominal_parameters[place])
        change = value / nominal - 1
        prior = float(before[i]) / abs(nominal)
        known.append(KnownParameter.of(name, change, prior, left[i, i]))
    for i, label in enumerate(estimator.noise_labels):
        # Half of a variance's logarithm is that of the deviation.
        change = float(fit.noise[i] - fit.rule.prior_mean[i]) / 2
        place = n_parameters + i
        known.append(KnownParameter.of(f"noise of {label}", change, width / 2, left[place, place]))
    return Known(tuple(known), directions_of(left))
