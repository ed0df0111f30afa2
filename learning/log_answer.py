"""What a log says of θ: `TrainingFromData`, the answer of `learning.train_from_data`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from controllers.problem import Problem
from controllers.theta import Parameters
from cosim.core.logged_data import LoggedData
from cosim.core.logged_readings import LoggedReadings
from cosim.core.protocols import Array, Vector
from cosim.core.result import Shown
from cosim.core.scenario import Scenario
from cosim.core.statistics import Estimate, shown
from learning.log_configuration import LogConfiguration
from learning.log_prediction import difference
from learning.training_run import TrainingRun

LogVerdict = Literal["better", "cannot tell"]


class KnownParameter(NamedTuple):
    """Estimate of a parameter, or a nominal disturbance, of the model from the log.

    Attributes:
        name: its name.
        change: its error as estimated, as a share of its value.
        deviation: standard deviation of that.
        prior_deviation: the same before the log.
        shown: share of its prior variance that the log has removed.
    """

    name: str
    change: float
    deviation: float
    prior_deviation: float
    shown: float

    @classmethod
    def of(cls, name: str, change: float, prior_deviation: float, left: float) -> KnownParameter:
        """From the share of the prior variance that is left."""
        return cls(name, change, prior_deviation * left**0.5, prior_deviation, 1.0 - left)


class Direction(NamedTuple):
    """A direction of the parameters' and nominal disturbances' errors, over their priors.

    Attributes:
        shown: share of its prior variance that the log has removed.
        weights: of each parameter and disturbance, in their order, (p,); of length one.
    """

    shown: float
    weights: tuple[float, ...]


class Known(NamedTuple):
    """What a log says of a plant's model.

    Attributes:
        parameters: of each parameter and nominal disturbance of the model; of a log of readings,
            of each uncertain parameter and each noise's deviation.
        directions: of these, what the log shows least first.
    """

    parameters: tuple[KnownParameter, ...]
    directions: tuple[Direction, ...]


class BoundMove(NamedTuple):
    """What moving one bound of the learned θ is predicted to cost.

    Attributes:
        bound: its state and side, `X2 ≥` say.
        by: how far it moves, in the state's unit: one deviation of the one-step prediction.
        difference: J of the moved θ less that of the learned one.
        interval: its 95 % interval; None where the moved θ is lost on a model.
    """

    bound: str
    by: float
    difference: float
    interval: tuple[float, float] | None

    @property
    def is_told(self) -> bool:
        """Whether the log says if that is better or worse."""
        if self.interval is None:
            return False
        low, high = self.interval
        return low > 0 or high < 0


@dataclass(frozen=True, repr=False)
class TrainingFromData(Shown):
    """Result of learning from a log.

    Attributes:
        run: the training's rule, scenario, settings and start.
        log_settings: what of the log was refused or left out, and how θ was judged.
        data: the transitions, or rows, that were used, and what was left out.
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
        known: what the log says of the model.
        moves: what moving each bound of the learned θ is predicted to cost, either way; of those
            that are in reach.
        excitation: of each action, the part of its standard deviation that does not follow from
            the states, as a share of its range.
        cost_is_modelled: whether the stage cost is the model's, since it was not logged.
        outside: share of the samples predicted of the learned θ in which a state is where the
            plant has not been.
    """

    run: TrainingRun
    log_settings: LogConfiguration
    data: LoggedData | LoggedReadings
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
    known: Known
    moves: tuple[BoundMove, ...]
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
        return sum(direction.shown > least for direction in self.known.directions)

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
        for parameter in self.known.parameters:
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
            "directions": [direction._asdict() for direction in self.known.directions],
            "moves": [move._asdict() | {"is_told": move.is_told} for move in self.moves],
            "directions_shown": self.directions_shown,
            "excitation": dict(self.excitation),
            "stage_cost_by_the_model": self.cost_is_modelled,
            "share_of_samples_outside_the_log": self.outside,
        }


def excitation(states: Array, actions: Array, scenario: Scenario) -> dict[str, float]:
    """Part of each action's movement that the states do not explain, as a share of its range.

    The actions of a controller that adds no excitation follow from the states. Its log then tells
    the actions' effect from the disturbances' by the model alone.

    Args:
        states: of the log or estimates of them, (M, n).
        actions: (M, m).
        scenario: names the actions, and has their ranges.
    """
    n = len(states)
    regressors = np.column_stack([np.ones(n), states, np.vstack([states[:1], states[:-1]])])
    ranges = scenario.action_upper - scenario.action_lower
    free = {}
    for i, name in enumerate(scenario.plant.actions):
        action = actions[:, i]
        coefficients, *_ = np.linalg.lstsq(regressors, action, rcond=None)
        rest = action - regressors @ coefficients
        free[name] = float(rest.std() / ranges[i])
    return free


def _upper_end(estimate: Estimate) -> float:
    """The upper end of an interval; infinite without one."""
    return np.inf if estimate.interval is None else estimate.interval[1]


class Differences(NamedTuple):
    """Predicted differences of J.

    Attributes:
        against_logged: of the learned θ less the logged operation.
        against_start: of the learned θ less the start.
        start_against_logged: of the start less the logged operation.
        model_share: the models' share of the doubt, of the difference that is shown least.
    """

    against_logged: Estimate
    against_start: Estimate
    start_against_logged: Estimate
    model_share: float


def differences_of(
    of_learned: Array,
    of_start: Array,
    logged: Array,
    stretches: Sequence[int],
    from_log: Callable[[Array, Array, Sequence[int]], tuple[Estimate, float]],
) -> Differences:
    """Differences of J by the costs that D models predict.

    Args:
        of_learned: of the learned θ, (D, T).
        of_start: of the start on the same disturbances, (D, T).
        logged: of the logged operation, (D, M).
        stretches: numbers of stretches that the samples are parted in.
        from_log: `difference` where θ meets the log's own disturbances, else
            `difference_of_separate`.
    """
    against_start = difference(of_learned, of_start, stretches)
    against_logged = from_log(of_learned, logged, stretches)
    start_against_logged, _ = from_log(of_start, logged, stretches)
    _, share = max(against_start, against_logged, key=lambda shown: _upper_end(shown[0]))
    return Differences(against_logged[0], against_start[0], start_against_logged, share)


def directions_of(left: Array) -> tuple[Direction, ...]:
    """Directions of errors, what the log shows least first.

    Args:
        left: their covariance after the log, over their prior deviations, (p, p).
    """
    eigenvalues, vectors = np.linalg.eigh(left)
    directions = []
    # Ascending is the variance that is left: what is shown least comes last.
    for value, vector in zip(eigenvalues[::-1].tolist(), vectors.T[::-1], strict=True):
        # Of a direction's two signs the one with its largest weight above zero.
        sign = np.sign(vector[np.argmax(np.abs(vector))])
        weights = tuple((sign * vector).tolist())
        directions.append(Direction(1.0 - value, weights))
    return tuple(directions)


class MovedBound(NamedTuple):
    """θ with one of its state bounds moved.

    Attributes:
        bound: its state and side, `X2 ≥` say.
        by: how far it moves, in the state's unit.
        theta: θ.
    """

    bound: str
    by: float
    theta: Parameters


def moved_bounds(theta: Parameters, problem: Problem, deviation: Vector) -> list[MovedBound]:
    """θ with one of its state bounds moved, each either way.

    Args:
        theta: θ.
        problem: names the states, and has their true bounds.
        deviation: by which the bound of each state moves, (n,).
    """
    moved = []
    sides = (("x_l", "≥", problem.state_lower), ("x_u", "≤", problem.state_upper))
    for i, quantity in enumerate(problem.model.states):
        for block, sign, true_bounds in sides:
            # There is nothing to move where there is no bound.
            if not np.isfinite(true_bounds[i]):
                continue
            for step in (-float(deviation[i]), float(deviation[i])):
                bounds = theta[block].copy()
                bounds[i] += step
                words = f"{quantity.name} {sign}"
                moved.append(MovedBound(words, step, theta.replace({block: bounds})))
    return moved


def moves_of(
    moved: Sequence[MovedBound],
    costs: Sequence[Array],
    of_learned: Array,
    stretches: Sequence[int],
) -> tuple[BoundMove, ...]:
    """What moving each bound is predicted to cost; one out of reach, which costs nothing, is not.

    Args:
        moved: the bounds.
        costs: of D models and T samples with each, (D, T).
        of_learned: the same of the learned θ, (D, T).
        stretches: numbers of stretches that the samples are parted in.
    """
    moves = []
    for one, of_one in zip(moved, costs, strict=True):
        if is_same_cost(of_one, of_learned):
            continue
        estimate, _ = difference(of_one, of_learned, stretches)
        moves.append(BoundMove(one.bound, one.by, estimate.value, estimate.interval))
    return tuple(moves)


def is_same_cost(one: Array, other: Array) -> bool:
    """Whether costs are equal but for rounding: a bound that is out of reach was moved."""
    return bool(np.allclose(one, other, rtol=1e-9, atol=0.0))
