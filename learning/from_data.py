"""`train_from_data`: θ from a plant's log alone; no plant is stepped.

The empirical model is fitted to the logged transitions, and a rule proposes θ: `model-based` by its
search on that model, `batch-q-learning` by replaying the log. What θ would have cost is then
predicted on the log's own disturbances: the model's errors are played back in their order, so that
under the logged actions it repeats the log, and two controllers meet the same. This is done for
draws from the posterior of the model's coefficients, so that the intervals hold what the log does
not say of the plant, beside the chance of its disturbances.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit
from threadpoolctl import threadpool_limits

from controllers.factories import nmpc
from controllers.problem import Problem
from controllers.rti import RtiNmpc
from controllers.theta import Parameters
from cosim.core.logged_data import LoggedData, LoggedDataError, read_logged_data
from cosim.core.protocols import Array, Step, Vector
from cosim.core.result import Shown
from cosim.core.scenario import Scenario
from cosim.core.statistics import LEVEL, Estimate, shown
from cosim.core.training_options import TrainingOptions
from learning.algorithm import load_algorithm
from learning.batch_q_learning import BatchQLearning
from learning.configuration import Configuration
from learning.empirical_model import (
    INTEGRATION_ERROR,
    EmpiricalModel,
    EmpiricalModelConfiguration,
    Features,
)
from learning.errors import ConfigurationError, DivergenceError
from learning.exploration import Strategy
from learning.loop import TrainingLoop
from learning.model_based import BackOffOnModel, ExpectedCosts, ModelBased, ModelBasedConfiguration
from learning.plant_data import PlantData
from learning.rollout import Rollout
from learning.training_run import TrainingRun, make_run

RULES = ("model-based", "batch-q-learning")
"""Rules that can learn from a log."""
SHIFTS = (-2, -1, 1, 2)
"""Rows by which the inputs may be logged early or late, to be looked for."""
EVIDENCE = 10.0
"""Nats by which the log must speak for another reading of itself to be refused."""
UNLIKE = 5.0
"""Times that the nominal model may err as much as "nothing changes" does, before it is no model."""
BIASED = 0.5
"""Mean error that it must have for that, over h: as of disturbances half their magnitude off."""
JUMP = 10.0
"""Standard deviations, by the median, from which on an error is a jump."""
JUMP_BACK = 4.0
"""Standard deviations from which on an error after a jump may be the one back."""
ALIKE = 1.3
"""Largest ratio of the two jumps."""
DROPOUT = 10
"""Most rows from a jump to the one back."""
DRAWS = 24
"""Models that are drawn from the posterior."""
BLOCKS = (16, 8)
"""Numbers of stretches of the log by whose spread the chance of disturbances is told."""
LOST = 1e6
"""Times the largest cost of the log beyond which a rollout has run away."""
COST_NOISE = 1e-4
"""Size of the noise that a cost gets which is the model's own, as a share of its mean."""
SETTLING = 300
"""Samples of a rollout, and of the log, before they count: a quarter of the log at most."""
HARDLY_SHOWN = 0.5
"""Share of the prior variance of a parameter left by the log from which on it does not show it."""

LogVerdict = Literal["better", "cannot tell"]


class KnownParameter(NamedTuple):
    """What the log says of a parameter, or a nominal disturbance, of the model.

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


@dataclass(frozen=True, repr=False)
class TrainingFromData(Shown):
    """What a log has taught.

    Attributes:
        run: the training's rule, scenario, settings and start.
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
        directions_shown: number of the directions of these that the log shows.
        excitation: of each action, the part of its standard deviation that does not follow from
            the states, as a share of its range.
        cost_is_modelled: whether the stage cost is the model's, since it was not logged.
        outside: share of the samples predicted of the learned θ in which a state is where the
            plant has not been.
    """

    run: TrainingRun
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
    directions_shown: int
    excitation: Mapping[str, float]
    cost_is_modelled: bool
    outside: float

    @property
    def verdict(self) -> LogVerdict:
        """`better` where the learned θ is shown to cost less than the log and than the start."""
        for difference in (self.against_logged, self.against_start):
            if difference.interval is None or not difference.interval[1] < 0:
                return "cannot tell"
        return "better"

    @property
    def parameters(self) -> Parameters:
        """The θ to use: the learned one where it is better, else the start's."""
        return self.learned if self.verdict == "better" else self.start

    @property
    def experiment(self) -> str:
        """What would tell, in a sentence; empty where the verdict is `better`."""
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
            difference: Estimate = getattr(self, name)
            differences[name] = difference.value
            differences[f"{name}_interval"] = difference.interval
        return {
            "algorithm": self.run.algorithm,
            "scenario": self.run.scenario.name,
            "scenario_hash": self.run.scenario.hash,
            "start": self.run.start,
            "seed": self.run.seed,
            "hyperparameters": self.run.configuration.model_dump(mode="json"),
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
            "directions": len(self.parameters_known),
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
    run = make_run(algorithm, scenario, 1, settings, options)
    _check_run(run)
    problem = Problem.from_scenario(scenario)
    if not isinstance(data, LoggedData):
        data = read_logged_data(
            data,
            scenario,
            columns=columns,
            units=units_of(problem),
            leave_out=leave_out,
        )
    # The rules' matrices are small: BLAS's second thread spins for longer than it computes.
    with threadpool_limits(limits=1, user_api="blas"):
        return _train(run, problem, data)


def units_of(problem: Problem) -> dict[str, str]:
    """Unit of each state and action of a problem's model, by name."""
    quantities = (*problem.model.states, *problem.model.actions)
    return {quantity.name: quantity.unit for quantity in quantities}


def _check_run(run: TrainingRun) -> None:
    """Refuse by ConfigurationError what cannot learn from a log."""
    if run.algorithm not in RULES:
        raise ConfigurationError(
            f"{run.algorithm} cannot learn from logged data; {' and '.join(RULES)} can"
        )
    for kind, tables in (("sensors", run.scenario.sensors), ("signals", run.scenario.signals)):
        if tables:
            raise ConfigurationError(
                f"scenario '{run.scenario.name}' has {kind}, and a log is used only where the "
                "states themselves are logged and nothing moves with time but them"
            )


def _train(run: TrainingRun, problem: Problem, data: LoggedData) -> TrainingFromData:
    """Fit, propose θ, and predict what it costs."""
    settings = run.configuration
    if not isinstance(settings, ModelBasedConfiguration):
        settings = ModelBasedConfiguration.from_dict({}).for_scenario(run.scenario)
    cost_is_modelled = data.stage_cost is None
    plant_problem = _with_nominal_cost(problem) if cost_is_modelled else problem
    features = Features(plant_problem, settings.smallest_error_size)
    data = usable(data, run.scenario, features, settings)
    inputs, outputs = _table(data, features)
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

    prediction = _Prediction(
        problem,
        rollout,
        model,
        inputs,
        outputs,
        settings,
        data.follows,
    )
    draws = prediction.draws([theta, start.theta], rng)
    of_learned = draws.costs[0]
    of_start = draws.costs[1]
    realised = outputs[:, -1] + run.scenario.state_penalty.along(data.states)
    against_start, share_against_start = difference(of_learned, of_start)
    against_logged, share_against_logged = difference(of_learned, draws.logged)
    model_share = share_against_start
    if _upper_end(against_logged) > _upper_end(against_start):
        model_share = share_against_logged
    start_against_logged, _ = difference(of_start, draws.logged)
    known, directions_shown = _known_parameters(problem, model, settings)
    return TrainingFromData(
        run=run,
        data=data,
        start=start,
        learned=start.with_theta(theta),
        status=status,
        logged_cost=float(realised.mean()),
        modelled_cost=float(draws.logged.mean()),
        start_cost=float(of_start.mean()),
        learned_cost=float(of_learned.mean()),
        against_logged=against_logged,
        against_start=against_start,
        start_against_logged=start_against_logged,
        model_share=model_share,
        parameters_known=known,
        directions_shown=directions_shown,
        excitation=excitation(data, run.scenario),
        cost_is_modelled=cost_is_modelled,
        outside=draws.outside,
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


def _table(data: LoggedData, features: Features) -> tuple[Array, Array]:
    """Inputs (s, a), (M, n+m), and outputs (s₊, ℓ), (M, K), of a log's transitions."""
    inputs = np.column_stack([data.states, data.actions])
    stage_cost = data.stage_cost
    if stage_cost is None:
        y, _, _ = features(inputs, np.zeros(features.n_parameters))
        nominal = y[:, -1]
        # An output without any error has no size, and its rounding would look like one.
        noise = np.random.default_rng(0).standard_normal(len(nominal))
        stage_cost = nominal + COST_NOISE * np.abs(nominal).mean() * noise
    return inputs, np.column_stack([data.next_states, stage_cost])


def usable(
    data: LoggedData,
    scenario: Scenario,
    features: Features,
    settings: EmpiricalModelConfiguration,
) -> LoggedData:
    """The transitions that the nominal model can make sense of.

    Refused is a log that speaks for another reading of itself, or of which the model makes nothing;
    left out are jumps that no plant makes, and data from before a change of the plant.

    Args:
        data: the transitions.
        scenario: names the variables.
        features: the nominal model.
        settings: how many are remembered, and how a change is told.

    Raises:
        LoggedDataError: the log is doubtful.
    """
    data = data.latest(settings.memory)
    _check_reading(data, scenario, features)
    data = data.without(_jumps(data, features), "jump there and back")
    inputs, outputs = _table(data, features)
    n_outdated = PlantData(features, settings).outdated(inputs, outputs)
    before_a_change = np.arange(len(data)) < n_outdated
    return data.without(before_a_change, "before a change of the plant")


def _nominal_errors(
    features: Features,
    states: Array,
    actions: Array,
    next_states: Array,
) -> tuple[Array, Array]:
    """Errors of the nominal model's states over h, and their least deviations, (M, n) each."""
    n = states.shape[1]
    inputs = np.column_stack([states, actions])
    y, _, h = features(inputs, np.zeros(features.n_parameters))
    sizes = h[:, :n]
    errors = (next_states - y[:, :n]) / sizes
    rounding = INTEGRATION_ERROR * np.abs(y[:, :n]) / sizes
    return errors, rounding


def _log_likelihood(errors: Array, rounding: Array) -> float:
    """Of normal errors (M, n) of mean zero and unknown covariance, but for a constant."""
    covariance = errors.T @ errors / len(errors)
    least = np.diag((rounding**2).mean(axis=0))
    _, logarithm = np.linalg.slogdet(covariance + least)
    return float(-len(errors) * logarithm / 2)


def _gain(reading: tuple[Array, Array], as_it_is: tuple[Array, Array]) -> float:
    """Nats by which a reading's errors (M, n) are likelier than those of the log as it is."""
    return _log_likelihood(*reading) - _log_likelihood(*as_it_is)


def _centred(reading: tuple[Array, Array]) -> tuple[Array, Array]:
    """Errors (M, n) less their mean, and the least deviations."""
    errors, rounding = reading
    return errors - errors.mean(axis=0), rounding


def _check_reading(data: LoggedData, scenario: Scenario, features: Features) -> None:
    """Refuse a log whose inputs are a row off, whose columns are exchanged, or of another plant.

    Only the nominal model is asked, and only whether it explains the states better when the log is
    read otherwise. A fitted model would find the controller's own law in inputs of the next row.
    """
    plant = scenario.plant
    # Rows of one unbroken stretch, so that an input may be taken some rows earlier or later.
    reach = max(SHIFTS)
    n_rows = len(data)
    middle = np.arange(reach, n_rows - reach)
    whole = np.ones(len(middle), bool)
    for shift in range(1 - reach, reach + 1):
        whole &= data.follows[middle + shift]
    rows = middle[whole]
    if len(rows) < 10 * features.n_outputs:
        return
    states = data.states[rows]
    actions = data.actions[rows]
    next_states = data.next_states[rows]

    as_it_is = _nominal_errors(features, states, actions, next_states)
    gains = {}
    # A shift leaves the mean error as it is, which is the plant's own.
    for shift in SHIFTS:
        way = "late" if shift > 0 else "early"
        words = f"the inputs are logged {abs(shift)} row{'s' * (abs(shift) > 1)} {way}"
        reading = _nominal_errors(features, states, data.actions[rows + shift], next_states)
        gains[words] = _gain(_centred(reading), _centred(as_it_is))
    # Exchanged columns have another mean, and may make the model's states stand still: it counts.
    for one, other in combinations(range(len(plant.actions)), 2):
        words = f"columns {plant.actions[one]} and {plant.actions[other]} are exchanged"
        exchanged = _exchanged(actions, one, other)
        reading = _nominal_errors(features, states, exchanged, next_states)
        gains[words] = _gain(reading, as_it_is)
    for one, other in combinations(range(len(plant.states)), 2):
        words = f"columns {plant.states[one]} and {plant.states[other]} are exchanged"
        exchanged = _exchanged(states, one, other)
        followers = _exchanged(next_states, one, other)
        reading = _nominal_errors(features, exchanged, actions, followers)
        gains[words] = _gain(reading, as_it_is)
    best = max(gains, key=lambda words: gains[words])
    if gains[best] > EVIDENCE:
        raise LoggedDataError(
            f"the log looks as if {best}: the model then explains it better by "
            f"{gains[best]:.0f} nats; correct the file (a dead time of the plant belongs in the "
            "model)"
        )

    # "Nothing changes" is the poorest model; one that is far poorer has other units.
    errors, _ = as_it_is
    inputs = np.column_stack([states, actions])
    y, _, h = features(inputs, np.zeros(features.n_parameters))
    changes = (next_states - states) / h[:, : states.shape[1]]
    for i, name in enumerate(plant.states):
        change = float(np.sqrt(np.mean(changes[:, i] ** 2)))
        if _is_unlike(errors[:, i], change):
            raise LoggedDataError(
                f"the model predicts {name} more than {UNLIKE:g} times worse than that it stays as "
                "it is: a unit or a column is wrong, or the model is of another plant"
            )
    if data.stage_cost is None:
        return
    stage_cost = data.stage_cost[rows]
    cost_errors = (stage_cost - y[:, -1]) / h[:, -1]
    spread = float(np.std(stage_cost / h[:, -1]))
    if _is_unlike(cost_errors, spread):
        raise LoggedDataError(
            f"the logged stage cost is {stage_cost.mean():.6g} on average, and the model's "
            f"{y[:, -1].mean():.6g}: another unit, or another cost? Without the column the model's "
            "is taken"
        )


def _is_unlike(errors: Array, spread: float) -> bool:
    """Whether a model's errors say that it is of something else, or in another unit.

    Args:
        errors: over h, (M,).
        spread: root mean square of what they must be small against, over h.
    """
    size = float(np.sqrt(np.mean(errors**2)))
    is_biased = abs(float(errors.mean())) > BIASED
    return size > UNLIKE * spread and is_biased


def _exchanged(table: Array, one: int, other: int) -> Array:
    """A table (M, ·) with two columns exchanged."""
    exchanged = table.copy()
    exchanged[:, [one, other]] = table[:, [other, one]]
    return exchanged


def _jumps(data: LoggedData, features: Features) -> NDArray[np.bool_]:
    """Transitions of a reading that leaves the plant's and comes back, (M,): a spike, a dropout.

    A disturbance of the plant, be it as large, does not jump back by itself.
    """
    errors, rounding = _nominal_errors(features, data.states, data.actions, data.next_states)
    distance = errors - np.median(errors, axis=0)
    # The median's deviation is not moved by the jumps themselves.
    deviation = 1.4826 * np.median(np.abs(distance), axis=0)
    deviation = np.maximum(deviation, rounding.mean(axis=0))
    sizes = np.abs(distance) / deviation
    changes = data.next_states - data.states
    jumps = np.zeros(len(data), bool)
    for size, change in zip(sizes.T, changes.T, strict=True):
        for there in np.flatnonzero(size > JUMP).tolist():
            back = _jump_back(there, size, change, data.follows)
            if back is not None:
                jumps[there : back + 1] = True
    return jumps


def _jump_back(
    there: int,
    size: Array,
    change: Array,
    follows: NDArray[np.bool_],
) -> int | None:
    """The transition in which a reading that has jumped comes back; None where it stays.

    Args:
        there: the transition of the jump.
        size: of the errors of this state, in deviations, (M,).
        change: of this state in each transition, (M,).
        follows: whether the transition before ends where this one begins, (M,).
    """
    for later in range(there + 1, min(there + 1 + DROPOUT, len(size))):
        if not follows[later]:
            return None
        # The model expects the plant to stay where the jump has led, not to come back.
        is_error = size[later] > JUMP_BACK
        if is_error and 1 / ALIKE < -change[later] / change[there] < ALIKE:
            return later
    return None


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


class _Draws(NamedTuple):
    """Costs that drawn models predict, D models of the M samples that count.

    Attributes:
        costs: of each θ, (D, M) each; infinite where a model's rollout is lost.
        logged: of the logged operation, (D, M).
        outside: share of the first θ's samples in which a state is where the plant has not been.
    """

    costs: list[Array]
    logged: Array
    outside: float


class _Prediction:
    """Predicts what θ would have cost on the disturbances of a log.

    Args:
        problem: has the penalty.
        rollout: of the problem's controller.
        model: the estimate from the log.
        inputs: (s, a), (M, n+m).
        outputs: (s₊, ℓ), (M, K).
        settings: of the fit and of the expected penalty.
        follows: whether each transition begins where the one before ends, (M,).
    """

    def __init__(
        self,
        problem: Problem,
        rollout: Rollout,
        model: EmpiricalModel,
        inputs: Array,
        outputs: Array,
        settings: ModelBasedConfiguration,
        follows: NDArray[np.bool_],
    ) -> None:
        self._problem = problem
        self._rollout = rollout
        self._model = model
        self._follows = follows
        self._inputs = inputs
        self._outputs = outputs
        self._settings = settings

    def draws(self, thetas: Sequence[Vector], rng: np.random.Generator) -> _Draws:
        """Costs of θ, (n_θ,) each, and of the log, by models drawn from the posterior."""
        # All begin at the log's first state, and count once they have settled.
        count = len(self._inputs)
        settling = min(SETTLING, count // 4)
        picks = np.arange(count, dtype=np.int32)
        start = self._inputs[0, : self._problem.n_states]
        costs = [np.full((DRAWS, count - settling), np.inf) for _ in thetas]
        logged = np.empty((DRAWS, count - settling))
        outside = []
        low = self._inputs.min(axis=0)
        high = self._inputs.max(axis=0)
        models = self._model.draws(
            self._inputs,
            self._outputs,
            self._settings,
            DRAWS,
            rng,
            self._follows,
        )
        for number, drawn in enumerate(models):
            model, errors_before = self._repeating(drawn)
            expected = ExpectedCosts(self._problem, model, self._settings)
            predicted, h, _ = model.predict(self._inputs)
            persists = h * (errors_before @ model.persistence.T)
            logged_costs, _ = expected(predicted + persists, h)
            logged[number] = logged_costs[settling:]
            limit = LOST * float(np.abs(logged_costs).max())
            rollouts = self._rollout(thetas, start, model, picks)
            for cost, samples in zip(costs, rollouts, strict=True):
                # A loop that runs away ends early.
                if len(samples.inputs) < count:
                    continue
                with np.errstate(over="ignore", invalid="ignore"):
                    all_costs, _ = expected(samples.predicted, samples.h)
                # A NaN is not below, either.
                if (np.abs(all_costs) < limit).all():
                    cost[number] = all_costs[settling:]
            n = self._problem.n_states
            states = rollouts[0].inputs[settling:, :n]
            is_outside = (states < low[:n]) | (states > high[:n])
            if len(states):
                outside.append(float(is_outside.any(axis=1).mean()))
        return _Draws(costs, logged, float(np.mean(outside)) if outside else 1.0)

    def _repeating(self, drawn: EmpiricalModel) -> tuple[EmpiricalModel, Array]:
        """A model with the errors that it makes of the log, in their order.

        Under the logged actions it repeats the log, whatever its coefficients.

        Args:
            drawn: the model.

        Returns:
            The model, and r of the sample before each, (M, K).
        """
        predicted, h, _ = drawn.predict(self._inputs)
        errors = (self._outputs - predicted) / h
        # A rollout begins without one, and after a gap goes on from the last one before it.
        before = np.concatenate([np.zeros_like(errors[:1]), errors[:-1]])
        residuals = errors - before @ drawn.persistence.T
        return replace(drawn, residuals=residuals), before


def difference(costs: Array, others: Array) -> tuple[Estimate, float]:
    """Mean difference of predicted costs, with an interval that holds model and chance.

    The variance is that over models, of the mean over samples, and that of the mean over stretches
    of the log, of the mean over models.

    Args:
        costs: of D models and M samples, (D, M).
        others: what is subtracted, (D, M).

    Returns:
        The estimate, without interval where a model's cost is not finite; and the models' share of
        its variance.
    """
    if not (np.isfinite(costs).all() and np.isfinite(others).all()):
        return Estimate(np.inf if not np.isfinite(costs).all() else -np.inf), 1.0
    differences = costs - others
    by_model = differences.mean(axis=1)
    value = float(by_model.mean())
    of_models = float(by_model.var(ddof=1))
    by_sample = differences.mean(axis=0)
    # Costs that are correlated for hours leave stretches that are not independent: the longer ones
    # count where their means spread more.
    of_chance = 0.0
    freedom_of_chance = BLOCKS[0] - 1
    for n_blocks in BLOCKS:
        blocks = np.array([block.mean() for block in np.array_split(by_sample, n_blocks)])
        of_the_mean = float(blocks.var(ddof=1)) / n_blocks
        if of_the_mean >= of_chance:
            of_chance = of_the_mean
            freedom_of_chance = n_blocks - 1
    variance = of_models + of_chance
    share = of_models / variance if variance else 0.0
    # Degrees of freedom of a sum of two variances (Welch and Satterthwaite).
    freedom = 1.0 / (share**2 / (DRAWS - 1) + (1.0 - share) ** 2 / freedom_of_chance)
    quantile = float(stdtrit(freedom, 0.5 + LEVEL / 2))
    half_width = quantile * variance**0.5
    return Estimate(value, (value - half_width, value + half_width)), share


def _upper_end(estimate: Estimate) -> float:
    """The upper end of an interval; infinite without one."""
    return np.inf if estimate.interval is None else estimate.interval[1]


def _known_parameters(
    problem: Problem,
    model: EmpiricalModel,
    settings: EmpiricalModelConfiguration,
) -> tuple[tuple[KnownParameter, ...], int]:
    """What the log says of each parameter, and the number of directions that it shows."""
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
    eigenvalues = np.linalg.eigvalsh(left)
    return tuple(known), int((eigenvalues < HARDLY_SHOWN).sum())


def excitation(data: LoggedData, scenario: Scenario) -> dict[str, float]:
    """How much of each action's movement does not follow from the states, as a share of its range.

    A controller that adds nothing of its own repeats what the states say, so that its log tells the
    actions' effect from the disturbances' by the model alone.

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
