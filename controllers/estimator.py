"""Output feedback: an extended Kalman filter on the controller's model, before any controller.

The filter has the states of the controller's model, x₊ = f(x, u, d, p), and those of its parameters
p that the model calls uncertain: without these it would blame the state for what a wrong parameter
does, and stay off. The disturbances d are taken as white noise about their nominal values, the
uncertain parameters as random walks, each sensor's noise as white. A reading that arrives late is
one of an earlier state: the filter keeps as many earlier states as the latest sensor needs.

The variances of these noises may be part of θ, as a block `noise` of their logarithms. A solution's
derivatives are then the total ones, through the estimate:

    dV/dθ = ∂V/∂θ + dV/dx̂ · dx̂/dθ,    dπ/dθ = ∂π/∂θ + dπ/dx̂ · dx̂/dθ

at the point where the QP was linearised (`controllers.estimator_sensitivities` has dx̂/dθ).

θ may have a block `margin` κ, two entries a state. A bound is then tightened by κ deviations of the
present estimate: x_l + κ_l √P_ii ≤ x_i ≤ x_u − κ_u √P_ii. So a back-off is small behind a reading
and grows until the next one.

Source: Anderson and Moore, Optimal Filtering, 1979, ch. 8.2 (extended filter), ch. 7.3 (the state
augmented by delayed ones).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import log, pi, sqrt
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from controllers.errors import ControllerError, ModelError, ModelWarning, ParameterError
from controllers.estimator_sensitivities import FilterSensitivities
from controllers.filter_engine import FilterEngine
from controllers.filter_model import bound_widths, filter_model
from controllers.functions import (
    COMPILED,
    INTERPRETED,
    LONG,
    StackedFunction,
    consecutive,
    not_in_c,
    worth_compiling,
)
from controllers.problem import Problem
from controllers.rti import RtiSolution, compile_functions
from controllers.theta import Parameters, ThetaBlocks, noise_block
from cosim.core.errors import warn
from cosim.core.modules import load_plugin
from cosim.core.protocols import Controller, Matrix, Solution, Vector
from cosim.core.scenario import EstimatorTable, Scenario, SensorTable

EXPECTED_DISTURBANCE = 0.1
"""Deviation that is expected of a disturbance, as a share of its magnitude."""
DRIFT_PERIOD = 86400.0
"""Seconds in which an uncertain parameter changes by `parameter_drift`."""
EXACT = 1e-6
"""Deviation of a sensor that is called exact, as a share of its variable's size: no rounding."""
LARGEST_MARGIN = 0.25
"""Share of the width between a state's bounds by which an estimate's deviation tightens one."""
UNSEEN = 1e-8
"""Share of the largest singular value below which a direction counts as not observed."""


ESTIMATOR_METHODS = ("predict", "correct", "reset", "state_dict", "load_state_dict")


class Estimator(Protocol):
    """Estimator of the state from the readings.

    A sample is `correct(y)`, after the first one preceded by `predict(a)` with the action that was
    applied.
    """

    @property
    def estimate(self) -> Vector:
        """Of the present state, (n,)."""

    def reset(self) -> None:
        """Forget every reading."""

    def predict(self, a: Vector) -> None:
        """Go on by a sample under the action a (m,)."""

    def correct(self, y: Vector) -> Vector:
        """Take up the readings y (n_y,), NaN where there is none; returns the estimate (n,)."""

    def state_dict(self) -> dict[str, Vector]:
        """Arrays that are all it remembers."""

    def load_state_dict(self, state: Mapping[str, Vector]) -> None:
        """Restore what `state_dict` returned."""


class ExtendedKalmanFilter:
    """An extended Kalman filter on a problem's model.

    Args:
        problem: Has the model with its nominal disturbances and parameters, and the reference, from
            which the first estimate starts.
        sensors: What is measured, n_y sensors of states of the model or of its `outputs`.
        disturbance_deviation: Expected deviations of the model's disturbances, (n_d,); without them
            a tenth of their magnitudes.
        sensor_deviation: Expected deviations of the sensors, (n_y,); without them their own.
        parameter_drift: Expected deviation of an uncertain parameter's change in a day, as a share
            of its nominal value; 0 takes the model's parameters as they are.
        differentiates: Whether to propagate derivatives by `noise`.

    Attributes:
        noise_labels: What the entries of `noise` are of: each disturbance, the change of each
            uncertain parameter in a sample, each sensor, (q,).
        log_likelihood: Of all readings since the last `reset`, by their innovations.
        standardised: Innovations of the last `correct` over their expected deviations, (n_y,), NaN
            where no reading came.
        sensitivities: The derivatives; None where it does not differentiate.

    Raises:
        ModelError: A sensor reads what is neither a state nor an output of the model, or a
            disturbance's size is not known.
        ControllerError: The sensors do not show a part of the state that does not decay.
    """

    def __init__(
        self,
        problem: Problem,
        sensors: Sequence[SensorTable],
        *,
        disturbance_deviation: ArrayLike | None = None,
        sensor_deviation: ArrayLike | None = None,
        parameter_drift: float = 0.1,
        differentiates: bool = False,
    ) -> None:
        self._problem = problem
        model = problem.model
        self._uncertain = model.parameter_indices(model.uncertain) if parameter_drift > 0 else []
        self.model = filter_model(problem, sensors, self._uncertain)
        self._transition = StackedFunction(self.model.transition)
        self._output = StackedFunction(self.model.output)
        self._n = self.model.start.size
        self._engine: FilterEngine | None = None
        self.functions = INTERPRETED
        self._view_memory()
        self.noise_labels = (
            *(f"disturbance {quantity.name}" for quantity in model.disturbances),
            *(f"parameter {model.parameters[i].name}" for i in self._uncertain),
            *(f"sensor {sensor.variable}" for sensor in sensors),
        )
        if disturbance_deviation is None:
            expected = EXPECTED_DISTURBANCE * model.disturbance_magnitudes
        else:
            expected = _of_size("disturbance_deviation", disturbance_deviation, model.disturbances)
        self._disturbance_variance[:] = expected**2
        nominal = model.nominal_parameters[self._uncertain]
        share = parameter_drift * np.sqrt(problem.sampling_time / DRIFT_PERIOD)
        self._drift_variance[:] = (share * np.abs(nominal)) ** 2
        if sensor_deviation is None:
            deviations = np.array([sensor.deviation for sensor in sensors])
        else:
            deviations = _of_size("sensor_deviation", sensor_deviation, sensors)
        self._sensor_variance[:] = np.maximum(deviations, EXACT * self._sizes_of_outputs()) ** 2
        self.sensitivities: FilterSensitivities | None = None
        if differentiates:
            self.sensitivities = FilterSensitivities(
                self._transition, self._output, self.model.n_kept, len(self._uncertain)
            )
        self._check_observability()
        self.reset()

    def _view_memory(self) -> None:
        """Make the memory, in the order of FilterMemory in C, and name its parts."""
        model = self.model
        n_sensors = len(model.delays)
        n_all = model.n_kept * self._n
        sizes = {
            "action": model.transition.inputs["u"],
            "y": n_sensors,
            "standardised": n_sensors,
            "log_likelihood": 1,
            "disturbance_variance": model.n_disturbances,
            "drift_variance": model.n_drifts,
            "sensor_variance": n_sensors,
            # C has no array of no entry.
            "sigma": max(len(model.signals), 1),
            "states": n_all,
            "covariance": n_all * n_all,
        }
        places = consecutive(sizes)
        memory = np.zeros(sum(sizes.values()))
        self._memory: Vector = memory
        self._action = memory[places["action"]]
        self._y = memory[places["y"]]
        self.standardised: Vector = memory[places["standardised"]]
        self._log_likelihood = memory[places["log_likelihood"]]
        self._disturbance_variance = memory[places["disturbance_variance"]]
        self._drift_variance = memory[places["drift_variance"]]
        self._sensor_variance = memory[places["sensor_variance"]]
        self._sigma = memory[places["sigma"]]
        # One after the other, as in `noise`.
        first = places["disturbance_variance"].start
        self._variances = memory[first : places["sensor_variance"].stop]
        # The present z and, behind it, those of earlier samples.
        self._states = memory[places["states"]].reshape(model.n_kept, self._n)
        self._covariance = memory[places["covariance"]].reshape(n_all, n_all)
        self._estimate = self._states[0, : self._problem.n_states]

    def compile(self, samples: int = LONG) -> None:
        """Compile for a run of `samples`, if it is long enough.

        As with a controller: COSIM_COMPILE=never forbids it, `now` compiles for any number, and
        without a compiler CasADi's functions and NumPy stay. Both give the same to rounding.
        `functions` says which of them it is.
        """
        if self.functions == COMPILED or not worth_compiling(samples):
            return
        reason = not_in_c([self.model.transition.function, self.model.output.function])
        if reason is not None:
            warn(f"{reason}: the estimator is not compiled, which is slower", ModelWarning)
            return
        slopes = None if self.sensitivities is None else self.sensitivities.memory
        engine = FilterEngine.compile(self.model, self._memory, slopes)
        if engine is None:
            return
        # A library that differs from the interpreter is refused: it would give wrong numbers fast.
        if not self._agrees_with(engine):
            warn(
                "the compiled model and CasADi's give different numbers: the estimator is not "
                "compiled, which is slower; set CC to another compiler",
                ModelWarning,
            )
            return
        self._engine = engine
        self.functions = COMPILED

    def _agrees_with(self, engine: FilterEngine) -> bool:
        """Whether a sample in compiled code is as here but for rounding, from start and reference.

        The memory stays as it is.
        """
        memories = [self._memory]
        if self.sensitivities is not None:
            memories.append(self.sensitivities.memory)
        saved = [memory.copy() for memory in memories]
        results = []
        for chosen in (engine, None):
            self._engine = chosen
            self.reset()
            for _ in range(2):
                self.predict(self._problem.reference_action)
                self.correct(np.zeros(len(self.model.delays)))
            results.append(self._scaled())
        for memory, content in zip(memories, saved, strict=True):
            memory[:] = content
        compiled, interpreted = results
        return np.allclose(compiled, interpreted, rtol=1e-9, atol=1e-9, equal_nan=True)

    def _scaled(self) -> Vector:
        """All z and covariances, their derivatives too, in units of the deviations at the start."""
        deviation = self.model.start_deviation
        unit = np.tile(np.where(deviation > 0.0, deviation, 1.0), self.model.n_kept)
        outer = np.outer(unit, unit)
        parts = [self._states.ravel() / unit, self._covariance / outer, self._log_likelihood]
        if self.sensitivities is not None:
            by_noise = self.sensitivities
            parts.append(by_noise.states.reshape(by_noise.size, -1) / unit)
            parts.append(by_noise.covariance / outer)
            parts.append(by_noise.log_likelihood)
        return np.concatenate([part.ravel() for part in parts])

    @classmethod
    def from_scenario(cls, scenario: Scenario, *, differentiates: bool = False) -> Self:
        """The filter of a scenario with sensors.

        Args:
            scenario: Has the tables `[[sensor]]` and `[estimator]`.
            differentiates: Whether to propagate derivatives by `noise`.
        """
        table = scenario.estimator or EstimatorTable()
        return cls(
            Problem.from_scenario(scenario),
            scenario.sensors or (),
            disturbance_deviation=table.disturbance_deviation,
            sensor_deviation=table.sensor_deviation,
            parameter_drift=table.parameter_drift,
            differentiates=differentiates,
        )

    def reset(self) -> None:
        """Forget every reading: the reference, and the initial deviation about it."""
        n = self._n
        self._states[:] = self.model.start
        self._covariance[:] = 0.0
        self._covariance[:n, :n] = np.diag(self.model.start_deviation**2)
        for number, (_, item) in enumerate(self.model.signals):
            self._sigma[number] = item.nominal
        self._log_likelihood[0] = 0.0
        self.standardised[:] = np.nan
        if self.sensitivities is not None:
            self.sensitivities.reset()

    @property
    def log_likelihood(self) -> float:
        """Of all readings since the last `reset`, by their innovations."""
        return float(self._log_likelihood[0])

    @property
    def noise(self) -> Vector:
        """Logarithms of the variances that `noise_labels` names, (q,), in the variables' units."""
        logarithms: Vector = np.log(self._variances)
        return logarithms

    @noise.setter
    def noise(self, noise: ArrayLike) -> None:
        self._variances[:] = np.exp(_of_size("noise", noise, self.noise_labels))

    def add_noise(self, parameters: Parameters) -> Parameters:
        """θ with this filter's `noise` as a block, its last; θ itself where it has one.

        Args:
            parameters: θ.
        """
        if "noise" in parameters.blocks:
            return parameters
        blocks = ThetaBlocks((*parameters.blocks, noise_block(self.noise_labels)))
        return Parameters(blocks, np.concatenate([parameters.theta, self.noise]))

    @property
    def estimate(self) -> Vector:
        """Of the present state, (n,)."""
        return self._estimate.copy()

    @property
    def parameters(self) -> dict[str, float]:
        """Estimates of the model's uncertain parameters, by name."""
        names = self._problem.model.uncertain if self._uncertain else ()
        values = self._states[0, self._problem.n_states :].tolist()
        return dict(zip(names, values, strict=True))

    @property
    def parameter_covariance(self) -> Matrix:
        """Of the error of the uncertain parameters' present estimates, (n_u, n_u)."""
        first = self._problem.n_states
        return self._covariance[first : self._n, first : self._n].copy()

    @property
    def initial_parameter_deviation(self) -> Vector:
        """Standard deviations of these errors before any reading, (n_u,)."""
        deviations: Vector = self.model.start_deviation[self._problem.n_states :].copy()
        return deviations

    @property
    def covariance(self) -> Matrix:
        """Of the present estimate's error, (n, n)."""
        n = self._problem.n_states
        return self._covariance[:n, :n].copy()

    def state_dict(self) -> dict[str, Vector]:
        """All that the filter remembers."""
        state = {"states": self._states.copy(), "covariance": self._covariance.copy()}
        if self.model.signals:
            state["sigma"] = self._sigma.copy()
        if self.sensitivities is not None:
            state |= self.sensitivities.state_dict()
        return state

    def load_state_dict(self, state: Mapping[str, Vector]) -> None:
        """Restore what `state_dict` returned."""
        self._states[:] = state["states"]
        self._covariance[:] = state["covariance"]
        if self.model.signals:
            self._sigma[:] = state["sigma"]
        if self.sensitivities is not None:
            self.sensitivities.load_state_dict(state)

    def inform(self, known: Mapping[str, Vector]) -> None:
        """Take up what signals of the model are from the present sample to the next.

        Args:
            known: Of each known signal, by its name, its present value first.
        """
        for number, (_, item) in enumerate(self.model.signals):
            self._sigma[number] = known[item.signal][0]

    def predict(self, a: ArrayLike) -> None:
        """Go on by a sample; a prediction that is not finite makes it forget every reading.

        Args:
            a: Action that was applied, (m,).
        """
        if self._engine is None:
            self._predict(a)
            covariance = self._covariance[: self._n, : self._n]
            finite = bool(np.isfinite(self._states[0]).all() and np.isfinite(covariance).all())
        else:
            self._action[:] = a
            finite = self._engine.predict()
        if not finite:
            # From what is not finite no reading leads back, and nothing is known of their law.
            self.reset()
            self._log_likelihood[0] = np.nan

    def _predict(self, a: ArrayLike) -> None:
        """`predict`, by CasADi's functions and NumPy."""
        n = self._n
        step = self._transition
        step.inputs["z"][:] = self._states[0]
        step.inputs["u"][:] = a
        step.inputs["sigma"][:] = self._sigma[: len(self.model.signals)]
        step()
        A = step.matrix("A").T
        G = step.matrix("G").T
        if self.sensitivities is not None:
            self.sensitivities.predict(
                self._covariance, self._disturbance_variance, self._drift_variance
            )
        # Every state moves back by one sample, the oldest is forgotten.
        kept = self._covariance[: self._covariance.shape[0] - n, : self._covariance.shape[0] - n]
        across = A @ self._covariance[:n]
        noise = (G * self._disturbance_variance) @ G.T
        # What drifts are the last entries of z.
        drifting = range(n - len(self._uncertain), n)
        noise[drifting, drifting] += self._drift_variance
        if self.model.n_kept > 1:
            self._covariance[n:, n:] = kept.copy()
            self._covariance[:n, n:] = across[:, : len(kept)]
            self._covariance[n:, :n] = self._covariance[:n, n:].T
            self._states[1:] = self._states[:-1].copy()
        self._covariance[:n, :n] = across[:, :n] @ A.T + noise
        self._states[0] = step.part("z_next")

    def correct(self, y: ArrayLike) -> Vector:
        """Take up the readings of a sample.

        Args:
            y: Readings, (n_y,), NaN where there is none.

        Returns:
            The estimate, (n,).

        Raises:
            ControllerError: y has another shape or is infinite.
        """
        readings = np.asarray(y, dtype=np.float64)
        if readings.shape != self._y.shape:
            raise self._unfit(readings)
        self._y[:] = readings
        taken = self._correct() if self._engine is None else self._engine.correct()
        if not taken:
            raise self._unfit(readings)
        return self._estimate.copy()

    def _unfit(self, readings: Vector) -> ControllerError:
        """The error of readings that cannot be taken up."""
        return ControllerError(
            f"y must be {self._y.size} readings, NaN where there is none, not {readings}"
        )

    def _correct(self) -> bool:
        """`correct`, by CasADi's functions and NumPy; False where a reading is infinite."""
        if np.isinf(self._y).any():
            return False
        self.standardised[:] = np.nan
        # One after the other: their noises are independent, so that nothing is inverted.
        for i in np.flatnonzero(~np.isnan(self._y)).tolist():
            self._correct_by(i, float(self._y[i]))
        return True

    def _correct_by(self, i: int, reading: float) -> None:
        """Take up the reading of sensor i."""
        n = self._n
        delay = self.model.delays[i]
        output = self._output
        output.inputs["z"][:] = self._states[delay]
        output()
        slope = output.matrix("C").T[i]
        first = delay * n
        # Covariance of the error with the predicted reading, and the variance of the latter.
        across = self._covariance[:, first : first + n] @ slope
        variance = slope @ across[first : first + n] + self._sensor_variance[i]
        gain = across / variance
        innovation = reading - output.part("y")[i]
        self.standardised[i] = innovation / sqrt(variance)
        self._log_likelihood[0] -= (innovation**2 / variance + log(2 * pi * variance)) / 2
        if self.sensitivities is not None:
            self.sensitivities.correct(
                i,
                delay,
                self._covariance,
                across,
                variance,
                innovation,
                self._sensor_variance[i],
            )
        self._states += (gain * innovation).reshape(self._states.shape)
        # Symmetric by its form; the sensor's variance keeps it positive semidefinite.
        self._covariance -= np.outer(gain, across)

    def expected_readings(self, s: ArrayLike, p: ArrayLike) -> Vector:
        """Values of the sensors' variables at a state, (n_y,).

        Args:
            s: State, (n,).
            p: All parameters of the model, of which the uncertain ones are taken, (n_p,).
        """
        n_states = self._problem.n_states
        self._output.inputs["z"][:n_states] = s
        self._output.inputs["z"][n_states:] = np.asarray(p)[self._uncertain]
        self._output()
        return self._output.part("y").copy()

    def _sizes_of_outputs(self) -> Vector:
        """Size of each sensor's variable over the bounds' widths about the reference, (n_y,)."""
        self._output.inputs["z"][:] = self.model.start
        self._output()
        n_states = self._problem.n_states
        sensitivity = np.abs(self._output.matrix("C").T[:, :n_states])
        sizes: Vector = sensitivity @ bound_widths(self._problem)
        return sizes

    def _check_observability(self) -> None:
        """Raise ControllerError where a direction of the state is neither seen nor decays."""
        problem = self._problem
        step = self._transition
        n = problem.n_states
        step.inputs["z"][:] = self.model.start
        step.inputs["u"][:] = problem.reference_action
        step.inputs["sigma"][:] = [item.nominal for _, item in self.model.signals]
        step()
        # In the widths of the bounds, so that no unit decides.
        widths = bound_widths(problem)
        A = step.matrix("A").T[:n, :n] * widths / widths[:, None]
        C = self._output.matrix("C").T[:, :n] * widths
        C = C / np.abs(C).max(axis=1, keepdims=True)
        names = [quantity.name for quantity in problem.model.states]
        for value in np.linalg.eigvals(A):
            if abs(value) < 1.0:
                continue
            # Popov, Belevitch and Hautus: a direction v with A v = λ v and C v = 0 is not seen.
            _, sizes, rows = np.linalg.svd(np.vstack([A - value * np.eye(n), C]))
            if sizes[-1] > UNSEEN * sizes[0]:
                continue
            direction = rows[-1].conj() * widths
            largest = int(np.argmax(np.abs(direction)))
            parts = []
            for name, part in zip(names, (direction / direction[largest]).real, strict=True):
                if abs(part) > UNSEEN:
                    parts.append(f"{part:+.3g} {name}")
            raise ControllerError(
                f"model '{problem.model.name}': the sensors do not show the direction "
                f"{' '.join(parts)} of the state, and it does not decay: no estimator can know it; "
                "add a [[sensor]] that depends on it"
            )


@dataclass(frozen=True)
class Margins:
    """How an estimate's deviation tightens the bounds x_l, then x_u: by amounts t (2n,).

    Attributes:
        amounts: t.
        by_margin: ∂t/∂κ of each one's own factor, (2n,); zero where t is limited.
        by_noise: dt/dη, (q, 2n); of no rows where the filter does not differentiate.
    """

    amounts: Vector
    by_margin: Vector
    by_noise: Matrix

    @classmethod
    def from_filter(cls, estimator: ExtendedKalmanFilter, factors: Vector, most: Vector) -> Margins:
        """Those of a filter's present estimate.

        Args:
            estimator: The filter.
            factors: κ, (2n,).
            most: Largest amounts, (2n,).
        """
        n = factors.size // 2
        # Rounding may leave less than nothing of the variance of a state that is known.
        variances = np.maximum(estimator.covariance.diagonal(), 0.0)
        deviations = np.sqrt(variances)
        wanted = factors * np.tile(deviations, 2)
        is_limited = wanted > most
        slopes = np.zeros((0, n))
        if estimator.sensitivities is not None:
            variance_slopes = estimator.sensitivities.covariance[:, range(n), range(n)]
            # Of a state that is known exactly the deviation stays zero.
            known = deviations == 0.0
            slopes = variance_slopes / np.where(known, np.inf, 2.0 * deviations)
        by_noise = factors * np.tile(slopes, 2)
        return cls(
            amounts=np.minimum(wanted, most),
            by_margin=np.where(is_limited, 0.0, np.tile(deviations, 2)),
            by_noise=np.where(is_limited, 0.0, by_noise),
        )


@dataclass(eq=False)
class EstimatedSolution(RtiSolution):
    """A solution at an estimate: its derivatives by θ include those through the estimate.

    Attributes:
        places: Of θ's blocks.
        by_noise: dx̂/dη, (q, n); None where θ has no block `noise`.
        margins: Of the bounds; None where θ has no block `margin`.
    """

    places: Mapping[str, slice] = field(kw_only=True, repr=False)
    by_noise: Matrix | None = field(kw_only=True, repr=False)
    margins: Margins | None = field(kw_only=True, repr=False)

    @cached_property
    def value_gradient(self) -> Vector:
        """dV/dθ or dQ/dθ, shape (n_θ,), through the estimate and its deviation too."""
        gradient = super().value_gradient.copy()
        if self.by_noise is not None:
            gradient[self.places["noise"]] = self.by_noise @ self.costates[0]
        self._add_margins(gradient[None])
        return gradient

    @property
    def policy_jacobian(self) -> Matrix:
        """dπ/dθ, shape (m, n_θ), through the estimate and its deviation too."""
        jacobian = super().policy_jacobian.copy()
        if self.by_noise is not None:
            jacobian[:, self.places["noise"]] = self.policy_state_jacobian @ self.by_noise.T
        self._add_margins(jacobian)
        return jacobian

    def _add_margins(self, derivatives: Matrix) -> None:
        """Add what goes through the tightened bounds to derivatives by θ (rows, n_θ)."""
        if self.margins is None:
            return
        places = self.places
        # A margin raises x_l and lowers x_u.
        by_lower = derivatives[:, places["x_l"]]
        by_upper = derivatives[:, places["x_u"]]
        by_amounts = np.concatenate([by_lower, -by_upper], axis=1)
        derivatives[:, places["margin"]] = by_amounts * self.margins.by_margin
        if self.by_noise is not None:
            derivatives[:, places["noise"]] += by_amounts @ self.margins.by_noise.T


class OutputFeedback:
    """A controller that is given measurements: an estimator, then a controller of the state.

    `prepare` predicts the state under the action that was applied, and lets the controller prepare;
    `feedback(y)` corrects the estimate, and feeds it back. Any other attribute is the controller's.
    Where θ has a block `noise` the estimator's variances are θ's, and the solutions' derivatives
    include those through the estimate. After θ has moved they are those of the trajectory as it
    was, with the past at the θ that it had. Where θ has a block `margin` each feedback tightens the
    controller's bounds by the present estimate's deviations.

    Args:
        estimator: Estimates the state.
        controller: Takes the estimate for the state.

    Raises:
        ParameterError: The block `noise` of θ is of another estimator, or θ has a block `margin`
            and the estimator is no extended Kalman filter.
    """

    given = "measurement"

    def __init__(self, estimator: Estimator, controller: Controller) -> None:
        self.estimator = estimator
        self.controller = controller
        self._noise_place: slice | None = None
        self._noise_of: Vector | None = None
        parameters = getattr(controller, "parameters", None)
        if isinstance(parameters, Parameters) and "noise" in parameters.blocks:
            _require_noise_of(estimator, parameters.blocks.block("noise").labels)
            self._noise_place = parameters.blocks.slices["noise"]
            self._set_noise()
        self._most_margins: Vector | None = None
        if isinstance(parameters, Parameters) and "margin" in parameters.blocks:
            if not isinstance(estimator, ExtendedKalmanFilter):
                raise ParameterError(
                    "θ has a block margin, deviations of an extended Kalman filter's estimate: "
                    "take estimator.kind 'ekf', or a θ without it"
                )
            self._most_margins = largest_margins(controller.problem)  # type: ignore[attr-defined]
        self._last_action: Vector | None = None
        self._known: Mapping[str, Vector] | None = None
        self._is_predicted = True
        self._is_corrected = False
        # Why the controller's preparation has failed; None where it has not.
        self._failure: Exception | None = None

    @classmethod
    def from_scenario(cls, scenario: Scenario, controller: Controller) -> OutputFeedback:
        """Put the scenario's estimator before a controller.

        Args:
            scenario: Has the tables `[[sensor]]` and `[estimator]`.
            controller: Takes the state.

        Raises:
            ControllerError: The scenario wants no estimator, or its factory makes none.
        """
        kind = (scenario.estimator or EstimatorTable()).kind
        if kind == "ekf":
            parameters = getattr(controller, "parameters", None)
            differentiates = isinstance(parameters, Parameters) and "noise" in parameters.blocks
            estimator = ExtendedKalmanFilter.from_scenario(scenario, differentiates=differentiates)
            return cls(estimator, controller)
        if kind == "none":
            raise ControllerError("estimator.kind is 'none': there is no estimator to put before")
        factory = load_plugin(kind, "estimator.kind", ControllerError)
        estimator = factory(scenario)
        if not all(hasattr(estimator, name) for name in ESTIMATOR_METHODS):
            raise ControllerError(
                f"estimator.kind '{kind}' made a {type(estimator).__name__}, which lacks "
                f"one of {', '.join(ESTIMATOR_METHODS)}"
            )
        return cls(estimator, controller)

    def __getattr__(self, name: str) -> Any:
        if name in ("controller", "compiled_loop"):
            # The first while a copy is made; a compiled loop knows of no estimator.
            raise AttributeError(name)
        return getattr(self.controller, name)

    @property
    def theta(self) -> Vector:
        """θ of the controller, (n_θ,)."""
        theta: Vector = self.controller.theta  # type: ignore[attr-defined]
        return theta

    @theta.setter
    def theta(self, theta: Vector) -> None:
        self.controller.theta = theta  # type: ignore[attr-defined]

    @property
    def estimate(self) -> Vector:
        """Of the present state, (n,)."""
        return self.estimator.estimate.copy()

    @property
    def functions(self) -> str:
        """`compiled` where controller and estimator both are, `interpreted` else."""
        of_controller: str = getattr(self.controller, "functions", INTERPRETED)
        of_estimator = getattr(self.estimator, "functions", of_controller)
        return of_controller if of_estimator == COMPILED else of_estimator

    def compile(self, samples: int = LONG) -> None:
        """Compile controller and filter for a run of `samples`, if it is long enough."""
        compile_functions(self.controller, samples)
        if isinstance(self.estimator, ExtendedKalmanFilter):
            self.estimator.compile(samples)

    def reset(self) -> None:
        """Forget every earlier sample."""
        self.estimator.reset()
        self.controller.reset()
        self._last_action = None
        self._known = None
        self._is_predicted = True
        self._is_corrected = False
        self._failure = None

    def state_dict(self) -> dict[str, Vector]:
        """Memory of the estimator after a `feedback`; the controller keeps its own."""
        return self.estimator.state_dict()

    def load_state_dict(self, state: Mapping[str, Vector]) -> None:
        """Restore what `state_dict` returned: the present sample's readings are in it."""
        self.estimator.load_state_dict(state)
        self._is_corrected = True

    def resume(self) -> None:
        """Reset the controller and keep the estimate: what follows a failed solve."""
        self.controller.reset()
        self._failure = None

    def inform(self, known: Mapping[str, Vector]) -> None:
        """Take up what is known of the scenario's signals at the sample to come.

        Args:
            known: Of each known signal, by its name, its values from that sample on.
        """
        self._known = known
        if hasattr(self.controller, "inform"):
            self.controller.inform(known)

    def prepare(self) -> None:
        """Predict the state, and do the controller's work that needs no measurement.

        Where that fails to make a QP, `feedback` says so, once it has taken up the readings: they
        come only once, and the next sample's estimate needs them.
        """
        if self._noise_place is not None:
            self._set_noise()
        if not self._is_predicted and self._last_action is not None:
            self.estimator.predict(self._last_action)
        # Only now: the prediction was of the sample before.
        if self._known is not None and isinstance(self.estimator, ExtendedKalmanFilter):
            self.estimator.inform(self._known)
        self._is_predicted = True
        self._is_corrected = False
        self._failure = None
        try:
            self.controller.prepare()
        except Exception as error:
            if not getattr(type(error), "is_solver_failure", False):
                raise
            self._failure = error

    @property
    def linearisation_point(self) -> Any:
        """The controller's; None where its preparation has failed."""
        if self._failure is not None:
            return None
        return self.controller.linearisation_point  # type: ignore[attr-defined]

    def feedback(self, y: ArrayLike, a: Vector | None = None) -> Solution:
        """Correct the estimate by the sample's readings, and solve for it.

        Args:
            y: Readings, (n_y,), NaN where nothing new came. A second call in a sample, with `a`,
                leaves the estimate as it is.
            a: Action to which the first one is fixed, (m,); without it the controller chooses.

        Raises:
            Exception: The controller's, of its preparation too; the readings are then taken up.
        """
        if self._is_corrected:
            estimate = self.estimator.estimate
        else:
            estimate = self.estimator.correct(np.asarray(y, dtype=np.float64))
            self._is_corrected = True
        if self._failure is not None:
            raise self._failure
        margins = self._tighten()
        solution = self.controller.feedback(estimate, a)
        if self._noise_place is not None or margins is not None:
            solution = self._differentiated(solution, margins)
        self._last_action = solution.action if a is None else a
        self._is_predicted = False
        return solution

    def _set_noise(self) -> None:
        """Give the estimator the variances of θ."""
        # θ is never written into: a θ that has moved is another array.
        if self._noise_place is not None and self.theta is not self._noise_of:
            self._noise_of = self.theta
            self.estimator.noise = self.theta[self._noise_place]  # type: ignore[attr-defined]

    def _tighten(self) -> Margins | None:
        """Tighten the controller's bounds by the present estimate's deviations, if θ says so."""
        if self._most_margins is None:
            return None
        controller: Any = self.controller
        factors = controller.parameters["margin"]
        estimator: Any = self.estimator
        margins = Margins.from_filter(estimator, factors, self._most_margins)
        lower, upper = np.split(margins.amounts, 2)
        controller.tighten(lower, upper)
        return margins

    def _differentiated(self, solution: Any, margins: Margins | None) -> EstimatedSolution:
        """A solution with the derivatives through the estimate and its deviations."""
        by_noise = None
        if self._noise_place is not None:
            n = self.estimator.estimate.size
            estimator: Any = self.estimator
            by_noise = estimator.sensitivities.states[:, 0, :n].copy()
        parameters: Parameters = self.controller.parameters  # type: ignore[attr-defined]
        return EstimatedSolution(
            action=solution.action,
            value=solution.value,
            prepared=solution.prepared,
            memory=solution.memory,
            enforced=solution.enforced,
            status=solution.status,
            places=parameters.blocks.slices,
            by_noise=by_noise,
            margins=margins,
        )

    def applied(self, a: Vector) -> None:
        """Say which action (m,) was applied, where it is not the solution's own."""
        self._last_action = a
        self._is_predicted = False


def measured(scenario: Scenario, controller: Controller) -> Controller:
    """The controller behind the scenario's estimator; itself where it needs none.

    Args:
        scenario: Has sensors, or none.
        controller: Takes the state, or what the sensors show.
    """
    table = scenario.estimator or EstimatorTable()
    takes_state = getattr(controller, "given", "state") == "state"
    if not scenario.sensors or table.kind == "none" or not takes_state:
        return controller
    return OutputFeedback.from_scenario(scenario, controller)


def largest_margins(problem: Problem) -> Vector:
    """Most that deviations tighten the lower, then the upper bounds by, (2n,): they never cross.

    Args:
        problem: The problem.
    """
    widths = problem.state_upper - problem.state_lower
    return np.tile(LARGEST_MARGIN * widths, 2)


def _require_noise_of(estimator: Estimator, labels: tuple[str, ...]) -> None:
    """Raise ParameterError unless an estimator has these noises, and derivatives by them."""
    theirs = getattr(estimator, "noise_labels", ())
    if theirs != labels:
        raise ParameterError(
            f"θ's block noise is of {', '.join(labels)}; the estimator's noise is of "
            f"{', '.join(theirs) or 'nothing'}: take a θ that was learned with these sensors"
        )
    if getattr(estimator, "sensitivities", None) is None:
        raise ParameterError(
            "θ has a block noise, and the estimator does not differentiate by it: make it with "
            "differentiates=True"
        )


def _of_size(name: str, values: ArrayLike, counted: Sequence[object]) -> Vector:
    """Values as an array; raises ModelError where they are not one for each of what is counted."""
    array = np.asarray(values, dtype=np.float64)
    if array.shape != (len(counted),):
        raise ModelError(f"estimator.{name} must have {len(counted)} entries, not {array.size}")
    return array
