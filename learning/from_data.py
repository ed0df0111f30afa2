"""`train_from_data`: θ from a plant's log alone; no plant is stepped.

The empirical model is fitted to the logged transitions, and a rule proposes θ: `model-based` by its
search on that model, `batch-q-learning` by replaying the log. `learning.log_checks` says what of
the log is used, and `learning.log_prediction` what θ would have cost on its own disturbances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from threadpoolctl import threadpool_limits

from controllers.factories import nmpc
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.logged_data import (
    FEWEST,
    LoggedData,
    LoggedDataError,
    LogTable,
    check_sizes,
    read_log,
    transitions_of,
)
from cosim.core.logged_readings import LoggedReadings, readings_of
from cosim.core.protocols import Array, Step, Vector
from cosim.core.scenario import Scenario
from cosim.core.training_options import TrainingOptions
from learning.algorithm import load_algorithm
from learning.batch_q_learning import BatchQLearning
from learning.configuration import Configuration
from learning.empirical_model import EmpiricalModel, EmpiricalModelConfiguration, Features
from learning.errors import ConfigurationError, DivergenceError
from learning.exploration import Strategy
from learning.from_readings import train_from_readings
from learning.log_answer import (
    Known,
    KnownParameter,
    TrainingFromData,
    differences_of,
    directions_of,
    excitation,
    moved_bounds,
    moves_of,
)
from learning.log_checks import inputs_and_outputs, plausible, usable
from learning.log_configuration import LogConfiguration
from learning.log_prediction import Prediction, difference
from learning.loop import TrainingLoop
from learning.model_based import (
    BackOffOnModel,
    ModelBased,
    ModelBasedConfiguration,
    one_step_deviation,
)
from learning.rollout import Rollout
from learning.training_run import TrainingRun, make_run

RULES = ("model-based", "batch-q-learning")
"""Rules that can learn from a log."""


def train_from_data(
    algorithm: str,
    data: LoggedData | str | Path,
    scenario: Scenario | str | Path = "paper",
    *,
    start: str | Path = "naive",
    seed: int = 0,
    controller: str = "rti",
    settings: Mapping[str, Any] | Configuration | None = None,
    log_settings: Mapping[str, Any] | LogConfiguration | None = None,
    columns: Mapping[str, str] | None = None,
    leave_out: Sequence[str] = (),
) -> TrainingFromData:
    """Learn θ from a log; no plant is stepped.

    Args:
        algorithm: `model-based` or `batch-q-learning`.
        data: the log's CSV file, or what has been read of it: `LoggedData`, with sensors
            `LoggedReadings`.
        scenario: a scenario, a preset's name or a TOML file.
        start: where θ starts: naive, tuned, backed-off, cautious or a file of θ.
        seed: of the search's noise and of the models drawn.
        controller: what carries θ, rti or converged.
        settings: hyperparameters by name; the algorithm's Configuration documents them.
        log_settings: what of a log is refused, left out or believed, by name; LogConfiguration
            documents it.
        columns: the file's name of a column by ours, where they differ.
        leave_out: `COLUMN=VALUE` each: rows that are left out.

    Raises:
        LoggedDataError: the log cannot be read, or does not fit the scenario.
        ConfigurationError: settings, or a scenario, with which no log can be used.
    """
    if not isinstance(scenario, Scenario):
        scenario = Scenario.load(scenario)
    options = TrainingOptions(
        seed=seed,
        start=str(start),
        controller=controller,
        evaluation_seeds=0,
    )
    checked_settings = LogConfiguration.of(log_settings)
    run = make_run(algorithm, scenario, 1, settings, options)
    _check_run(run)
    problem = Problem.from_scenario(scenario)
    log: LoggedData | LoggedReadings
    if isinstance(data, LoggedData | LoggedReadings):
        log = data
    else:
        # With sensors the log has their readings in place of the states.
        table = read_log(
            data,
            scenario,
            columns=columns,
            units=problem.model.variable_units,
            leave_out=leave_out,
            given=scenario.measurement_names or None,
        )
        log = readings_of(table, scenario) if scenario.sensors else transitions_of(table, scenario)
    # The rules' matrices are small: BLAS's second thread spins for longer than it computes.
    with threadpool_limits(limits=1, user_api="blas"):
        if scenario.sensors and isinstance(log, LoggedReadings):
            return train_from_readings(run, checked_settings, log)
        if not scenario.sensors and isinstance(log, LoggedData):
            return _train(run, checked_settings, problem, log)
    raise ConfigurationError(
        f"scenario '{scenario.name}' {'has' if scenario.sensors else 'has no'} sensors, and the "
        f"data are {type(log).__name__}: give the file itself"
    )


def _check_run(run: TrainingRun) -> None:
    """Refuse by ConfigurationError what cannot learn from a log."""
    if run.algorithm not in RULES:
        raise ConfigurationError(
            f"{run.algorithm} cannot learn from logged data; {' and '.join(RULES)} can"
        )
    if run.scenario.sensors and run.algorithm != "model-based":
        raise ConfigurationError(
            f"scenario '{run.scenario.name}' has sensors: {run.algorithm} would need the states "
            "themselves; from a log of readings model-based learns"
        )
    if run.scenario.signals:
        raise ConfigurationError(
            f"scenario '{run.scenario.name}' has signals, which a log does not hold: train without "
            "--data, in operation"
        )


def doubts_of(table: LogTable, scenario: Scenario) -> list[str]:
    """Why a training would refuse a log, or what of it it would leave out; in words, a line each.

    Args:
        table: its rows, with states.
        scenario: has no sensors.

    Returns:
        None of a log that is too short to tell.
    """
    settings = ModelBasedConfiguration.from_dict({}).for_scenario(scenario)
    try:
        check_sizes(table, scenario, scenario.plant.states)
        if len(table.time) <= FEWEST:
            return []
        # Without its stage cost, which has no part in what a controller does.
        data = replace(transitions_of(table, scenario), stage_cost=None)
        problem = _with_nominal_cost(Problem.from_scenario(scenario))
        features = Features(problem, settings.smallest_error_size)
        with threadpool_limits(limits=1, user_api="blas"):
            data = plausible(data, scenario, features, settings, LogConfiguration.of({}))
    except LoggedDataError as error:
        return [str(error)]
    doubts = []
    for reason, count in data.left_out.items():
        is_known = reason in (
            "by order",
            "repeated row",
            "missing value",
            "older than what is used",
        )
        if not is_known:
            doubts.append(f"{reason}: {count} pairs of rows")
    return doubts


def _train(
    run: TrainingRun,
    log_settings: LogConfiguration,
    problem: Problem,
    data: LoggedData,
) -> TrainingFromData:
    """Fit, propose θ, and predict what it costs."""
    settings = run.configuration
    if not isinstance(settings, ModelBasedConfiguration):
        settings = ModelBasedConfiguration.from_dict({}).for_scenario(run.scenario)
    cost_is_modelled = data.stage_cost is None
    plant_problem = _with_nominal_cost(problem) if cost_is_modelled else problem
    features = Features(plant_problem, settings.smallest_error_size)
    data = usable(data, run.scenario, features, settings, log_settings)
    inputs, outputs = inputs_and_outputs(data, features)
    model = _fitted(features, inputs, outputs, data, settings)
    start = run.starting_parameters()
    rollout = Rollout(problem, start, features)
    rng = np.random.default_rng(run.seed)

    status = "finished"
    theta = start.theta
    try:
        if run.algorithm == "model-based":
            rule = _OnALog(run, start, features, rollout, rng)
            theta = rule.learn(model, inputs)
        else:
            theta = _replayed(run, start, data, outputs)
    except DivergenceError as error:
        status = f"diverged: {error}"

    prediction = Prediction(
        problem,
        rollout,
        model,
        inputs,
        outputs,
        settings,
        data.follows,
    )
    learned = start.with_theta(theta)
    _, h, _ = model.predict(inputs)
    deviation = one_step_deviation(problem, model, h)
    moved = moved_bounds(learned, problem, deviation)
    thetas = [theta, start.theta, *(one.theta.theta for one in moved)]
    costs = prediction.costs(thetas, log_settings.drawn_models, rng)
    of_learned, of_start, *of_moved = costs.thetas
    realised = outputs[:, -1] + run.scenario.state_penalty.along(data.states)
    stretches = log_settings.stretches
    shown = differences_of(of_learned, of_start, costs.logged, stretches, difference)
    return TrainingFromData(
        run=run,
        log_settings=log_settings,
        data=data,
        start=start,
        learned=learned,
        status=status,
        logged_cost=float(realised.mean()),
        modelled_cost=float(costs.logged.mean()),
        start_cost=float(of_start.mean()),
        learned_cost=float(of_learned.mean()),
        **shown._asdict(),
        known=_known(problem, model, settings),
        moves=moves_of(moved, of_moved, of_learned, stretches),
        excitation=excitation(data.states, data.actions, run.scenario),
        cost_is_modelled=cost_is_modelled,
        outside=costs.outside,
    )


def _with_nominal_cost(problem: Problem) -> Problem:
    """The problem with a cost that no error of a parameter moves: it is known, not measured."""
    model = problem.model
    cost = model.economic_cost

    d = ca.SX(model.nominal_disturbance)
    p = ca.SX(model.nominal_parameters)

    def nominal(x: ca.SX, u: ca.SX, _d: ca.SX, _p: ca.SX) -> ca.SX:
        return cost(x, u, d, p)

    return replace(problem, model=replace(model, economic_cost=nominal))


def _fitted(
    features: Features,
    inputs: Array,
    outputs: Array,
    data: LoggedData,
    settings: EmpiricalModelConfiguration,
) -> EmpiricalModel:
    """The model of the log; raises LoggedDataError where none can be fitted."""
    try:
        return EmpiricalModel.fit(features, inputs, outputs, settings, follows=data.follows)
    except np.linalg.LinAlgError:
        raise LoggedDataError("no model can be fitted to the log") from None


class _OnALog(ModelBased):
    """`model-based` on a log: one model, one search."""

    explores = False

    def __init__(
        self,
        run: TrainingRun,
        start: Parameters,
        features: Features,
        rollout: Rollout,
        rng: np.random.Generator,
    ) -> None:
        controller = nmpc(run.scenario, start, run.controller)
        strategy = Strategy(run.configuration, run.scenario)
        super().__init__(controller, run.scenario, run.configuration, run.samples, strategy, rng)
        # The log's own: its cost may be the model's.
        self._features = features
        self._rollout = rollout

    def learn(self, model: EmpiricalModel, inputs: Array) -> Vector:
        """θ of least predicted cost, (n_θ,).

        Args:
            model: of the plant.
            inputs: the log's (s, a), (M, n+m).
        """
        settings = self.configuration
        present = self.controller.parameters
        recent = inputs[-settings.recent_samples :]
        base, gained = self.corrected(present, model, recent)
        # What c_f and the parameters correct, back-offs need not hold any more.
        shift = np.concatenate([gained, -gained])
        distance = self._problem.state_upper - self._problem.state_lower
        most = np.tile(settings.largest_back_off * distance, 2)
        kept = np.clip(self.back_off + shift, 0.0, most)
        least = self.least_back_offs(kept, inputs)
        search = BackOffOnModel(
            self._problem,
            self._rollout,
            base,
            model,
            recent,
            settings,
            self.rng,
            self._signals,
            range(len(recent)),
        )
        best = search.best(kept, least, settings.back_off_levels)
        return search.theta(best)


class _Log:
    """A log as a plant: whatever the action, what happened happens again.

    Args:
        scenario: has the penalty.
        data: its M transitions.
        outputs: their (s₊, ℓ), (M, K).
    """

    def __init__(self, scenario: Scenario, data: LoggedData, outputs: Array) -> None:
        self.scenario = scenario
        self._data = data
        self._outputs = outputs
        self._penalty = scenario.state_penalty
        self.number = 0

    def step(self, a: Vector) -> Step:
        """The next transition."""
        number = self.number
        self.number += 1
        penalty = self._penalty(self._data.states[number].tolist())
        next_state = self._data.next_states[number].copy()
        return Step(next_state, float(self._outputs[number, -1]), penalty, np.empty(0))


class _LoggedActions(Strategy):
    """The exploration of a replay: the logged action, whatever the policy's."""

    def __init__(self, run: TrainingRun, actions: Array) -> None:
        super().__init__(run.configuration, run.scenario)
        self._logged: list[Vector] = list(actions)

    def __call__(
        self,
        action: Vector,
        rng: np.random.Generator,
        number: int = 0,
    ) -> Vector | None:
        """The logged action of a sample, (m,)."""
        return self._logged[number]


def _replayed(
    run: TrainingRun,
    start: Parameters,
    data: LoggedData,
    outputs: Array,
) -> Vector:
    """θ after batch Q-learning has seen the log, sample by sample, (n_θ,).

    Raises DivergenceError where it diverges.
    """
    plant: Any = _Log(run.scenario, data, outputs)
    controller: RtiNmpc = nmpc(run.scenario, start, run.controller)
    strategy = _LoggedActions(run, data.actions)
    rng = np.random.default_rng(run.seed)
    rule_class = load_algorithm(run.algorithm)
    rule = rule_class(
        controller,
        run.scenario,
        run.configuration,
        len(data),
        strategy,
        rng,
    )
    assert isinstance(rule, BatchQLearning)
    loop = TrainingLoop(plant, controller, rule, strategy, rng)
    for state, follows in zip(data.states, data.follows, strict=True):
        # Across a gap nothing is known: the controller begins anew there.
        if not follows:
            loop.start(state.copy())
        loop.advance()
    return controller.theta.copy()


def _known(
    problem: Problem,
    model: EmpiricalModel,
    settings: EmpiricalModelConfiguration,
) -> Known:
    """Estimates of each parameter and nominal disturbance, and of directions of them.

    Args:
        problem: names parameters and nominal disturbances.
        model: of the plant.
        settings: the prior of the fit.
    """
    p = model.features.n_parameters
    prior = settings.parameter_deviation
    left = model.covariance[:p, :p] / prior**2
    quantities = (*problem.model.parameters, *problem.model.disturbances)
    known = []
    for i, quantity in enumerate(quantities):
        change = float(model.mean[i])
        known.append(KnownParameter.of(quantity.name, change, prior, float(left[i, i])))
    return Known(tuple(known), directions_of(left))
