"""`train_from_data`: θ from a plant's log alone; no plant is stepped.

The empirical model is fitted to the logged transitions, and a rule proposes θ: `model-based` by its
search on that model, `batch-q-learning` by replaying the log. `learning.log_checks` says what of
the log is used, and `learning.log_prediction` what θ would have cost on its own disturbances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from threadpoolctl import threadpool_limits

from controllers.factories import nmpc
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.logged_data import LoggedData, LoggedDataError, read_logged_data
from cosim.core.protocols import Array, Step, Vector
from cosim.core.result import Shown
from cosim.core.scenario import Scenario
from cosim.core.statistics import Estimate, shown
from cosim.core.training_options import TrainingOptions
from learning.algorithm import load_algorithm
from learning.batch_q_learning import BatchQLearning
from learning.configuration import Configuration
from learning.empirical_model import EmpiricalModel, EmpiricalModelConfiguration, Features
from learning.errors import ConfigurationError, DivergenceError
from learning.exploration import Strategy
from learning.log_checks import inputs_and_outputs, usable
from learning.log_configuration import LogConfiguration
from learning.log_prediction import Prediction, difference
from learning.loop import TrainingLoop
from learning.model_based import BackOffOnModel, ModelBased, ModelBasedConfiguration
from learning.rollout import Rollout
from learning.training_run import TrainingRun, make_run

RULES = ("model-based", "batch-q-learning")
"""Rules that can learn from a log."""
LogVerdict = Literal["better", "cannot tell"]


class KnownParameter(NamedTuple):
    """Estimate of a parameter, or a nominal disturbance, of the model from the log.

    Attributes:
        name: its name.
        change: its error as estimated, as a share of its value.
        deviation: standard deviation of that.
        shown: share of its prior variance that the log has removed.
    """

    name: str
    change: float
    deviation: float
    shown: float


class Direction(NamedTuple):
    """A direction of the parameters' and nominal disturbances' errors, over their priors.

    Attributes:
        shown: share of its prior variance that the log has removed.
        weights: of each parameter and disturbance, in their order, (p,); of length one.
    """

    shown: float
    weights: tuple[float, ...]


@dataclass(frozen=True, repr=False)
class TrainingFromData(Shown):
    """Result of learning from a log.

    Attributes:
        run: the training's rule, scenario, settings and start.
        log_settings: what of the log was refused or left out, and how θ was judged.
        data: the transitions that were used, and what was left out.
        start: the first θ.
        learned: the θ that the rule proposes.
        status: `finished`, or why the rule gave up.
        logged_cost: J of the logged operation, realised.
        modelled_cost: the same by the model, which it should repeat.
        start_cost: J that the model predicts of the start.
        learned_cost: J that it predicts of the learned θ.
        against_logged: J of the learned θ less that of the logged operation.
        against_start: J of the learned θ less that of the start.
        start_against_logged: J of the start less that of the logged operation.
        model_share: share of the variance that comes from what the log does not say of the plant,
            of the difference that is shown least; the rest is the chance of its disturbances.
        parameters_known: of each parameter and nominal disturbance of the model.
        prior_deviation: standard deviation of their errors before the log, as a share.
        directions: of these, what the log shows least first.
        excitation: of each action, the part of its standard deviation that does not follow from
            the states, as a share of its range.
        cost_is_modelled: whether the stage cost is the model's, since it was not logged.
        outside: share of the samples predicted of the learned θ in which a state is where the
            plant has not been.
    """

    run: TrainingRun
    log_settings: LogConfiguration
    data: LoggedData
    start: Parameters
    learned: Parameters
    status: str
    logged_cost: float
    modelled_cost: float
    start_cost: float
    learned_cost: float
    against_logged: Estimate
    against_start: Estimate
    start_against_logged: Estimate
    model_share: float
    parameters_known: tuple[KnownParameter, ...]
    prior_deviation: float
    directions: tuple[Direction, ...]
    excitation: Mapping[str, float]
    cost_is_modelled: bool
    outside: float

    @property
    def verdict(self) -> LogVerdict:
        """`better` where the learned θ is shown to cost less than the log and than the start."""
        for estimate in (self.against_logged, self.against_start):
            if not _upper_end(estimate) < 0:
                return "cannot tell"
        return "better"

    @property
    def parameters(self) -> Parameters:
        """The θ to use: the learned one where it is better, else the start's."""
        return self.learned if self.verdict == "better" else self.start

    @property
    def directions_shown(self) -> int:
        """Number of the directions that the log shows."""
        least = self.log_settings.least_shown
        return sum(direction.shown > least for direction in self.directions)

    @property
    def experiment(self) -> str:
        """Experiment that would tell, in a sentence; empty where the verdict is `better`."""
        if self.verdict == "better":
            return ""
        differences = (self.against_start, self.against_logged)
        uncertain = max(differences, key=_upper_end)
        if uncertain.interval is None:
            return (
                "the model cannot predict this θ: log a period with the start in charge, within "
                "bounds that it is known to keep"
            )
        if uncertain.value >= 0:
            return (
                "θ is not expected to cost less: the start is as good as the log can show; more "
                "data of the same kind would not change that"
            )
        half_width = uncertain.interval[1] - uncertain.value
        factor = (half_width / -uncertain.value) ** 2
        longer = f"a log about {max(factor, 1.1):.2g} times as long would tell"
        if self.model_share < 0.5:
            return f"the disturbances' chance decides: {longer}"
        name = min(self.excitation, key=lambda action: self.excitation[action])
        lower, upper = self.run.scenario.limits[name]
        return (
            f"the log does not show the plant well enough: {name} moved by itself by "
            f"{100 * self.excitation[name]:.2g} % of its range only. Steps of "
            f"±{0.05 * (upper - lower):.3g} on top of the controller, each held for some samples, "
            f"for a day, would show it; else {longer}"
        )

    def _facts(self) -> dict[str, object]:
        return {
            "algorithm": self.run.algorithm,
            "scenario": self.run.scenario.name,
            "transitions": len(self.data),
            "status": self.status,
            "verdict": self.verdict,
            "J logged": self.logged_cost,
            "J of the start": self.start_cost,
            "J of the learned θ": self.learned_cost,
            "against the log": shown(*self.against_logged, digits=3),
            "against the start": shown(*self.against_start, digits=3),
        }

    def summary(self) -> dict[str, Any]:
        """The answer as a JSON document."""
        known = []
        for parameter in self.parameters_known:
            known.append(parameter._asdict())
        differences: dict[str, Any] = {}
        for name in ("against_logged", "against_start", "start_against_logged"):
            estimate: Estimate = getattr(self, name)
            differences[name] = estimate.value
            differences[f"{name}_interval"] = estimate.interval
        return {
            "algorithm": self.run.algorithm,
            "scenario": self.run.scenario.name,
            "scenario_hash": self.run.scenario.hash,
            "start": self.run.start,
            "seed": self.run.seed,
            "hyperparameters": self.run.configuration.model_dump(mode="json"),
            "log_settings": self.log_settings.model_dump(mode="json"),
            "rows": self.data.rows,
            "transitions": len(self.data),
            "left_out": dict(self.data.left_out),
            "status": self.status,
            "verdict": self.verdict,
            "experiment": self.experiment,
            "parameters_hash": self.parameters.hash,
            "J_logged": self.logged_cost,
            "J_logged_by_the_model": self.modelled_cost,
            "J_of_the_start": self.start_cost,
            "J_of_the_learned_theta": self.learned_cost,
            **differences,
            "share_of_variance_from_the_model": self.model_share,
            "parameters_known": known,
            "directions": [direction._asdict() for direction in self.directions],
            "prior_deviation": self.prior_deviation,
            "directions_shown": self.directions_shown,
            "excitation": dict(self.excitation),
            "stage_cost_by_the_model": self.cost_is_modelled,
            "share_of_samples_outside_the_log": self.outside,
        }


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
        data: the log's CSV file, or what `cosim.core.logged_data` has read of it.
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
    if not isinstance(data, LoggedData):
        data = read_logged_data(
            data,
            scenario,
            columns=columns,
            units=problem.model.variable_units,
            leave_out=leave_out,
        )
    # The rules' matrices are small: BLAS's second thread spins for longer than it computes.
    with threadpool_limits(limits=1, user_api="blas"):
        return _train(run, checked_settings, problem, data)


def _check_run(run: TrainingRun) -> None:
    """Refuse by ConfigurationError what cannot learn from a log."""
    if run.algorithm not in RULES:
        raise ConfigurationError(
            f"{run.algorithm} cannot learn from logged data; {' and '.join(RULES)} can"
        )
    for kind, tables in (("sensors", run.scenario.sensors), ("signals", run.scenario.signals)):
        if tables:
            raise ConfigurationError(
                f"scenario '{run.scenario.name}' has {kind}: learning from a log needs the "
                "states themselves, and neither sensors nor signals; train without --data, in "
                "operation; `cosim shadow` takes such a log"
            )


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
    costs = prediction.costs([theta, start.theta], log_settings.drawn_models, rng)
    of_learned, of_start = costs.thetas
    realised = outputs[:, -1] + run.scenario.state_penalty.along(data.states)
    stretches = log_settings.stretches
    against_start, share_against_start = difference(of_learned, of_start, stretches)
    against_logged, share_against_logged = difference(of_learned, costs.logged, stretches)
    start_against_logged, _ = difference(of_start, costs.logged, stretches)
    model_share = share_against_start
    if _upper_end(against_logged) > _upper_end(against_start):
        model_share = share_against_logged
    known, directions = _known_parameters(problem, model, settings)
    return TrainingFromData(
        run=run,
        log_settings=log_settings,
        data=data,
        start=start,
        learned=start.with_theta(theta),
        status=status,
        logged_cost=float(realised.mean()),
        modelled_cost=float(costs.logged.mean()),
        start_cost=float(of_start.mean()),
        learned_cost=float(of_learned.mean()),
        against_logged=against_logged,
        against_start=against_start,
        start_against_logged=start_against_logged,
        model_share=model_share,
        parameters_known=known,
        prior_deviation=settings.parameter_deviation,
        directions=directions,
        excitation=excitation(data, run.scenario),
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


def _upper_end(estimate: Estimate) -> float:
    """The upper end of an interval; infinite without one."""
    return np.inf if estimate.interval is None else estimate.interval[1]


def _known_parameters(
    problem: Problem,
    model: EmpiricalModel,
    settings: EmpiricalModelConfiguration,
) -> tuple[tuple[KnownParameter, ...], tuple[Direction, ...]]:
    """Estimates of each parameter, and of directions of them, least known first.

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
        variance = float(left[i, i])
        change = float(model.mean[i])
        deviation = prior * variance**0.5
        known.append(KnownParameter(quantity.name, change, deviation, 1.0 - variance))
    eigenvalues, vectors = np.linalg.eigh(left)
    directions = []
    # Ascending is the variance that is left: what is shown least comes last.
    for value, vector in zip(eigenvalues[::-1].tolist(), vectors.T[::-1], strict=True):
        # Of a direction's two signs the one with its largest weight above zero.
        sign = np.sign(vector[np.argmax(np.abs(vector))])
        weights = tuple((sign * vector).tolist())
        directions.append(Direction(1.0 - value, weights))
    return tuple(known), tuple(directions)


def excitation(data: LoggedData, scenario: Scenario) -> dict[str, float]:
    """Part of each action's movement that the states do not explain, as a share of its range.

    The actions of a controller that adds no excitation follow from the states. Its log then tells
    the actions' effect from the disturbances' by the model alone.

    Args:
        data: the transitions.
        scenario: names the actions, and has their ranges.
    """
    n = len(data)
    regressors = np.column_stack(
        [np.ones(n), data.states, np.vstack([data.states[:1], data.states[:-1]])]
    )
    ranges = scenario.action_upper - scenario.action_lower
    free = {}
    for i, name in enumerate(scenario.plant.actions):
        action = data.actions[:, i]
        coefficients, *_ = np.linalg.lstsq(regressors, action, rcond=None)
        rest = action - regressors @ coefficients
        free[name] = float(rest.std() / ranges[i])
    return free
