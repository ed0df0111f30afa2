"""Derivatives of the extended Kalman filter by the logarithms of its noises' variances.

Estimate ẑ and covariance P are differentiated forward in time, by the same recursions that the
filter has: `predict` and `correct` differentiate one step each. Beside them goes the likelihood of
the readings, Σ log N(innovation; 0, variance), which says how well the variances fit the data.

Source: Gupta and Mehra, IEEE Transactions on Automatic Control 19(6), 1974.
"""

from __future__ import annotations

from collections.abc import Mapping

import casadi as ca
import numpy as np

from controllers.functions import StackedFunction, consecutive, define
from cosim.core.protocols import Array, Vector


class FilterSensitivities:
    """dẑ/dη and dP/dη by the log variances η (q,) of disturbances, drifts and sensors, in order.

    The filter calls `predict` and `correct` before it changes its own estimate and covariance.

    Args:
        transition: z₊, A = ∂z₊/∂z and G = ∂z₊/∂d, by (z, u).
        output: y and C = ∂y/∂z, by z.
        n_kept: How many samples of z the filter keeps, the present one included.
        n_drifts: Number of parameters, the last entries of z, that drift.

    Attributes:
        memory: All of them in one array.
        states: dẑ/dη of each sample that is kept, (q, n_kept, n).
        covariance: dP/dη, (q, n_kept n, n_kept n).
        log_likelihood: By η, of the readings since the last reset, (q,).
    """

    def __init__(
        self,
        transition: StackedFunction,
        output: StackedFunction,
        n_kept: int,
        n_drifts: int,
    ) -> None:
        self._transition = transition
        self._output = output
        self._n, self._n_disturbances = transition.shapes["G"]
        self._n_sensors = output.shapes["y"][0]
        self._n_kept = n_kept
        self._n_drifts = n_drifts
        self.size = self._n_disturbances + n_drifts + self._n_sensors
        self._transition_by_z = _by_z(transition, self.size)
        self._output_by_z = _by_z(output, self.size)
        # One array, in the order of FilterSlopes in C.
        n_all = n_kept * self._n
        sizes = {"states": self.size * n_all, "covariance": self.size * n_all**2}
        places = consecutive(sizes | {"log_likelihood": self.size})
        self.memory: Vector = np.zeros(places["log_likelihood"].stop)
        states = self.memory[places["states"]]
        self.states: Array = states.reshape(self.size, n_kept, self._n)
        covariance = self.memory[places["covariance"]]
        self.covariance: Array = covariance.reshape(self.size, n_all, n_all)
        self.log_likelihood: Vector = self.memory[places["log_likelihood"]]

    def reset(self) -> None:
        """Forget every reading: where the filter starts does not depend on η."""
        self.memory[:] = 0.0

    def state_dict(self) -> dict[str, Vector]:
        """All derivatives of what the filter remembers."""
        return {
            "states_by_noise": self.states.copy(),
            "covariance_by_noise": self.covariance.copy(),
        }

    def load_state_dict(self, state: Mapping[str, Vector]) -> None:
        """Restore what `state_dict` returned."""
        self.states[:] = state["states_by_noise"]
        self.covariance[:] = state["covariance_by_noise"]

    def predict(
        self,
        covariance: Array,
        disturbance_variance: Vector,
        drift_variance: Vector,
    ) -> None:
        """Differentiate P₊ = A P Aᵀ + G Σ Gᵀ + Σ_drift, and what the filter shifts.

        Args:
            covariance: P before the step.
            disturbance_variance: Diagonal of Σ.
            drift_variance: Of the parameters that drift.
        """
        n = self._n
        step = self._transition
        A = step.matrix("A").T
        G = step.matrix("G").T
        by_noise = _evaluated(self._transition_by_z, step, self.states[:, 0])
        # CasADi has columns one after the other.
        A_by_noise = by_noise[:, step.slices["A"]].reshape(-1, n, n).swapaxes(1, 2)
        G_by_noise = by_noise[:, step.slices["G"]].reshape(self.size, self._n_disturbances, n)
        G_by_noise = G_by_noise.swapaxes(1, 2)

        # As in the filter: the present block, what lies between it and earlier ones, and the rest.
        across = A_by_noise @ covariance[:n] + A @ self.covariance[:, :n]
        through_A = A @ covariance[:n, :n] @ A_by_noise.swapaxes(1, 2)
        through_G = (G_by_noise * disturbance_variance) @ G.T
        present = across[:, :, :n] @ A.T + through_A + through_G + through_G.swapaxes(1, 2)
        # A variance is the derivative of itself by its logarithm.
        for i, variance in enumerate(disturbance_variance):
            present[i] += variance * np.outer(G[:, i], G[:, i])
        first_parameter = n - self._n_drifts
        for i, variance in enumerate(drift_variance):
            place = first_parameter + i
            present[self._n_disturbances + i, place, place] += variance

        if self._n_kept > 1:
            self.covariance[:, n:, n:] = self.covariance[:, :-n, :-n].copy()
            self.covariance[:, :n, n:] = across[:, :, :-n]
            self.covariance[:, n:, :n] = self.covariance[:, :n, n:].swapaxes(1, 2)
            self.states[:, 1:] = self.states[:, :-1].copy()
        self.covariance[:, :n, :n] = present
        self.states[:, 0] = by_noise[:, step.slices["z_next"]]

    def correct(
        self,
        i: int,
        delay: int,
        covariance: Array,
        across: Vector,
        variance: float,
        innovation: float,
        sensor_variance: float,
    ) -> None:
        """Differentiate the correction ẑ + K e, P − K cᵀ with c = P Cᵀ, K = c/v, v = C c + r.

        Args:
            i: The sensor.
            delay: Samples since it read.
            covariance: P before the correction.
            across: c, (n_kept n,).
            variance: v.
            innovation: e, the reading less the expected one.
            sensor_variance: r.
        """
        n = self._n
        output = self._output
        slope = output.matrix("C").T[i]
        by_noise = _evaluated(self._output_by_z, output, self.states[:, delay])
        reading_by_noise = by_noise[:, output.slices["y"]][:, i]
        slope_by_noise = by_noise[:, output.slices["C"]].reshape(-1, n, self._n_sensors)[:, :, i]

        taken = slice(delay * n, (delay + 1) * n)
        across_by_noise = self.covariance[:, :, taken] @ slope
        across_by_noise += slope_by_noise @ covariance[:, taken].T
        variance_by_noise = slope_by_noise @ across[taken] + across_by_noise[:, taken] @ slope
        own = self._n_disturbances + self._n_drifts + i
        variance_by_noise[own] += sensor_variance

        gain = across / variance
        gain_by_noise = (across_by_noise - variance_by_noise[:, None] * gain) / variance
        change = gain_by_noise * innovation - reading_by_noise[:, None] * gain
        self.states += change.reshape(self.states.shape)
        self.covariance -= gain_by_noise[:, :, None] * across
        self.covariance -= gain[:, None] * across_by_noise[:, None, :]
        # Of −(e²/v + log 2πv)/2; the innovation moves against the expected reading.
        share = innovation / variance
        self.log_likelihood += share * reading_by_noise
        self.log_likelihood += (share**2 - 1.0 / variance) * variance_by_noise / 2


def _by_z(function: StackedFunction, size: int) -> StackedFunction:
    """A function's stacked results, differentiated by z in so many directions Z (n, size)."""
    symbols = {name: ca.SX.sym(name, array.size) for name, array in function.inputs.items()}
    stacked: ca.SX = function.function(*symbols.values())
    Z = ca.SX.sym("Z", symbols["z"].numel(), size)
    moved = ca.jtimes(stacked, symbols["z"], Z)
    name = f"{function.function.name()}_by_z"
    return StackedFunction(define(name, {**symbols, "Z": Z}, {"moved": moved}))


def _evaluated(by_z: StackedFunction, function: StackedFunction, directions: Array) -> Array:
    """The derivatives, one row a direction, where `function` was evaluated last.

    Args:
        by_z: Made of `function`.
        function: Has the arguments.
        directions: Rows are directions of z, (q, n).
    """
    for name, array in function.inputs.items():
        by_z.inputs[name][:] = array
    by_z.inputs["Z"][:] = directions.reshape(-1)
    by_z()
    return by_z.matrix("moved")
