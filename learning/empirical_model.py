"""A model of a plant from its own operation: what the controller's nominal model lacks.

(s₊, ℓ) = y(s, a; c) + W (1, s, a) + h(s, a) r. y is the nominal model with its economic cost, whose
parameters are c times their value larger, and its disturbances c times their magnitude. h is the
size of the error that disturbances in proportion to their magnitudes would make. c and W are
estimated from transitions by Bayesian generalised least squares, in Gauss-Newton steps since y is
not linear in c; the width of the prior of W's slopes is the one of greatest evidence (MacKay 1992).
Errors persist where disturbances do: r₊ = Φ r + e. The residuals e are kept and drawn anew. The
model knows no parameter of the plant and no law of its disturbances.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources import files
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from controllers.functions import c_source, library, not_in_c, work_sizes
from controllers.model import discretise, economic_cost
from controllers.problem import MODEL_KINDS, Problem, of_kind
from cosim.core.protocols import Array
from cosim.core.scenario import NonNegative, Positive
from learning.checkpoint import State
from learning.configuration import Configuration, Count, Share
from learning.prediction_errors import (
    effective_number,
    error_covariance,
    estimate_persistence,
    mean_error_covariance,
)

Rows = NDArray[np.intp]
"""Numbers of samples."""
INTEGRATION_ERROR = 1e-6
"""Least deviation of an output, as a share of its size: two integrators differ by as much."""
LEAST_COMBINATION = 1e-2
"""Least eigenvalue of the errors' correlation: a combination of outputs errs by a tenth of them."""
BLOCK = 250
"""Rows of the fit that are factored at a time: as many as fit in a processor's cache."""


class EmpiricalModelConfiguration(Configuration):
    """Hyperparameters of the empirical model and of its data, for the rules that use one."""

    memory: Count = Field(20_000, description="samples that the model remembers")
    parameter_deviation: Positive = Field(
        0.15,
        description="prior standard deviation of a parameter's error, as a share of its value",
    )
    largest_parameter_error: Positive = Field(
        0.5,
        description="largest error of a parameter, as a share of its value",
    )
    slope_deviations: tuple[Positive, ...] = Field(
        (0.1, 0.01, 0.001),
        description="prior standard deviations of W's slopes to choose from by evidence, in "
        "standard deviations of the error over one of the input; where errors persist the least",
    )
    smallest_error_size: Positive = Field(
        0.1,
        description="least h, as a share of its value at the reference",
    )
    persistence_doubt: NonNegative = Field(
        4.0,
        description="standard deviations by which errors must look correlated in time, or they "
        "count as independent",
    )
    largest_persistence: Share = Field(
        0.99,
        description="largest share of an error that the next sample keeps: errors that last for "
        "100 samples; what lasts longer is a mean",
    )
    fit_rounds: Count = Field(
        6,
        description="fits, each about the parameters and with the residuals' covariance of the one "
        "before",
    )
    parameter_rounds: Count = Field(
        3,
        description="fits of the parameters alone before those, which take errors as independent",
    )
    fit_samples: Count = Field(
        2000,
        description="samples of which all fits but the last take no more than twice as many",
    )
    refit_growth: Count = Field(
        8,
        description="growth of the data after which the model is fitted again: one in so many",
    )
    change_windows: tuple[Count, Count, Count, Count] = Field(
        (15, 60, 240, 960),
        description=(
            "windows of latest samples whose means are tested for a change of the plant, "
            "each time that the first number of samples has come"
        ),
    )
    change_probability: Share = Field(
        1e-7,
        description="probability of a window's mean error below which the plant has changed",
    )
    smallest_change: NonNegative = Field(
        1e-3,
        description="mean error, in an output's standard deviations, that is no change however "
        "exact the model is",
    )
    suspicion_probability: Share = Field(
        1e-4,
        description="the same for a window that also costs more than predicted",
    )
    forecast_samples: Count = Field(
        240,
        description="least number of latest samples whose prediction decides about older data",
    )
    forecast_evidence: NonNegative = Field(
        3.0,
        description="nats by which older data must spoil that prediction to be dropped",
    )
    earlier_residuals: Count = Field(
        480,
        description="number of residuals up to which those from before a change are kept",
    )


def displaced(
    nominal: Array,
    magnitudes: Array,
    share: Any,
) -> list[Any]:
    """Values a share of their magnitude away from the nominal ones.

    Args:
        nominal: values, (n,).
        magnitudes: (n,).
        share: numbers or CasADi expressions, (n,).

    Returns:
        nominal + magnitude · share of each.
    """
    values = []
    pairs = zip(nominal, magnitudes, strict=True)
    for i, (value, magnitude) in enumerate(pairs):
        if value == 0:
            values.append(magnitude * share[i])
            continue
        # A factor of one where the magnitude is the value's own.
        relative = magnitude / value
        values.append(value * (1 + relative * share[i]))
    return values


class Features:
    """The nominal model as a function of its parameters' errors c (p,), for K = n + 1 outputs.

    The cost is the last output. Parameters are the model's and then its nominal disturbances. What
    a known signal gives of the model, a disturbance, a parameter or a price, is an input v behind
    the action, and its error c has no effect.

    Args:
        problem: has the nominal model.
        smallest_error_size: least h, as a share of its value at the reference.

    Attributes:
        mean: CasADi function of (s, (a, v), c): y (K,) and h (K,); h is that of c = 0.
        n_inputs: n + m + n_v, the entries of (s, a, v).
        n_signals: n_v.
        n_outputs: K.
        n_parameters: p.
    """

    def __init__(self, problem: Problem, smallest_error_size: float = 0.1) -> None:
        x, u, v, c, y = _with_errors(problem)
        n_parameters = len(problem.model.parameters)
        G = ca.jacobian(y, c)
        # h is that of c = 0: it must not move with what is fitted.
        by_disturbance = G[:, n_parameters:]
        no_errors = ca.DM.zeros(c.shape)
        at_nominal = ca.substitute(by_disturbance, c, no_errors)
        # To the functions what signals give is no other than what actions do.
        u = ca.vertcat(u, v)
        h = _error_sizes(problem, x, u, at_nominal, smallest_error_size)
        y = ca.densify(y)
        G = ca.densify(G)

        # One function for the loop (y, h), one for the fit, which needs G too.
        arguments = [x, u, c]
        names = ["x", "u", "c"]
        mean = [y, h]
        features = [y, G.T, h]
        self.mean = ca.Function("nominal", arguments, mean, names, ["y", "h"])
        self._function = ca.Function("features", arguments, features, names, ["y", "G", "h"])
        self.n_outputs, self.n_parameters = G.shape
        self.n_signals = v.numel()
        self.n_inputs = problem.n_states + problem.n_actions + self.n_signals
        self.compiled: Any = None
        if not_in_c([self._function]) is None:
            self._compile(problem.n_states)

    def _compile(self, n_states: int) -> None:
        """Have the function in C, which needs no copies; without a compiler CasADi's stays."""
        sizes = {
            "N_X": n_states,
            "N_IN": self.n_inputs,
            "K": self.n_outputs,
            "P": self.n_parameters,
            **work_sizes("FEATURES", self._function),
        }
        function = c_source([self._function])
        loop = files("learning") / "features.c"
        # The loop includes CasADi's function: no name of that leaves the library.
        sources: dict[str, str | bytes] = {
            "sizes.h": c_definitions(sizes),
            "nominal.h": f"#define CASADI_SYMBOL_EXPORT static\n{function}",
            "features.c": loop.read_bytes(),
        }
        path = library(sources)
        if path is not None:
            self.compiled = ctypes.CDLL(str(path)).features_at

    def __call__(self, inputs: Array, c: Array) -> tuple[Array, Array, Array]:
        """The nominal model at many inputs.

        Args:
            inputs: (s, a, v), (M, n+m+n_v).
            c: errors of the parameters, (p,).

        Returns:
            y (M, K), its derivative by c, G (M, K, p), and h (M, K).
        """
        M = len(inputs)
        K = self.n_outputs
        shape_of_G = (M, K, self.n_parameters)
        if self.compiled is not None:
            y = np.empty((M, K))
            G = np.empty(shape_of_G)
            h = np.empty((M, K))
            rows = np.ascontiguousarray(inputs)
            arguments = pointers(rows, c)
            results = pointers(y, G, h)
            self.compiled(*arguments, ctypes.c_longlong(M), *results)
            return y, G, h
        n = K - 1
        states = inputs[:, :n]
        actions = inputs[:, n:]
        y_columns, G_columns, h_columns = self._function(states.T, actions.T, c)
        # CasADi has a sample in each column, and G's transposes side by side.
        y = y_columns.full().T
        h = h_columns.full().T
        G = G_columns.full().T
        return y, G.reshape(shape_of_G), h


def _with_errors(problem: Problem) -> tuple[ca.SX, ca.SX, ca.SX, ca.SX, ca.SX]:
    """Symbols of x, u, v and the parameters' errors c, and the outputs y = (s₊, ℓ) as of these."""
    model = problem.model
    x, u, d, p = model.symbols()
    simulate = discretise(model, problem.sampling_time, problem.substeps)
    cost = economic_cost(model)
    next_x = simulate(x, u, d, p)
    stage_cost = cost(x, u, d, p)
    outputs = ca.vertcat(next_x, stage_cost)

    # Parameters are c times their value larger, disturbances c times their magnitude.
    n_parameters = p.numel()
    n_disturbances = d.numel()
    c = ca.SX.sym("c", n_parameters + n_disturbances)
    growth = 1 + c[:n_parameters]
    parameters = ca.DM(model.nominal_parameters) * growth
    disturbances = displaced(
        model.nominal_disturbance,
        model.disturbance_magnitudes,
        c[n_parameters:],
    )
    at_errors = ca.vertcat(parameters, *disturbances)
    # What a signal gives is known, without an error.
    given = of_kind(problem.varying, *MODEL_KINDS)
    v = ca.SX.sym("v", len(given))
    for i, (_, item) in enumerate(given):
        place = item.place
        if item.kind == "disturbance":
            place += n_parameters
        at_errors[place] = v[i]
    symbols = ca.vertcat(p, d)
    (y,) = ca.substitute([outputs], [symbols], [at_errors])
    return x, u, v, c, y


def _error_sizes(
    problem: Problem,
    x: ca.SX,
    u: ca.SX,
    by_disturbance: ca.SX,
    smallest: float,
) -> ca.SX:
    """h (K,): the error that disturbances in proportion to their magnitudes would make.

    Args:
        problem: has the reference.
        x: symbol of the state.
        u: symbol of the action and of what signals give, (a, v).
        by_disturbance: derivative of the outputs by the disturbances' errors, (K, n_d).
        smallest: least h, as a share of its value at the reference.
    """
    size = ca.sqrt(ca.sum2(by_disturbance**2))
    size_at = ca.Function("size", [x, u], [size])
    given = [item.nominal for _, item in of_kind(problem.varying, *MODEL_KINDS)]
    action_and_signals = np.concatenate([problem.reference_action, given])
    at_reference = size_at(problem.reference_state, action_and_signals)
    references = at_reference.full()[:, 0]
    entries = ca.vertsplit(size)
    floored = []
    for entry, reference in zip(entries, references, strict=True):
        if reference > 0:
            floored.append(ca.fmax(entry, smallest * reference))
        else:
            # An output that no disturbance moves has no size; it is in its own unit.
            floored.append(ca.SX(1.0))
    return ca.densify(ca.vertcat(*floored))


class _Design(NamedTuple):
    """The model at M inputs, linear about parameters c.

    Attributes:
        y: (M, K).
        G: derivative of y by c, (M, K, p).
        h: (M, K).
        rows: derivative of the outputs by (c, W), (M, K, p + K(1+n+m)).
    """

    y: Array
    G: Array
    h: Array
    rows: Array

    @property
    def over_h(self) -> Array:
        """The derivative over the size of the errors: that of what is fitted."""
        size: Array = self.h[:, :, None]
        return self.rows / size


class Standardisation(NamedTuple):
    """The unit of the inputs (n+m,), so that one width of the prior serves all slopes.

    Attributes:
        centre: is zero in these units.
        unit: is one.
    """

    centre: Array
    unit: Array

    def design(
        self,
        features: Features,
        inputs: Array,
        c: Array,
    ) -> _Design:
        """The model at inputs, linear about parameters.

        Args:
            features: the nominal model.
            inputs: (s, a), (M, n+m).
            c: errors of the parameters, (p,).
        """
        y, G, h = features(inputs, c)
        standardised = (inputs - self.centre) / self.unit
        return _Design(y, G, h, design_rows(G, standardised))


class _Regression:
    """The regression of outputs (M, K) on inputs (M, n+m), linear about parameters c.

    A fit takes every `step`-th sample, and with each the one before where errors persist; a sample
    that does not follow the one before it (`follows`) is then left out.
    """

    def __init__(
        self,
        features: Features,
        inputs: Array,
        outputs: Array,
        settings: EmpiricalModelConfiguration,
        follows: NDArray[np.bool_] | None = None,
    ) -> None:
        self._features = features
        self._inputs = inputs
        self._outputs = outputs
        self._settings = settings
        if follows is None:
            follows = np.arange(len(inputs)) > 0
        self._follows = follows
        unit = inputs.std(axis=0)
        unit = np.where(unit > 0, unit, 1.0)
        self.standardisation = Standardisation(inputs.mean(axis=0), unit)

    def equations(
        self,
        c: Array,
        step: int,
        persistence: Array,
    ) -> tuple[Array, Array]:
        """Design (·, K, q) and target (·, K) of a fit about c, over h.

        Args:
            c: errors of the parameters, (p,).
            step: every so many samples are taken.
            persistence: Φ, (K, K).
        """
        rows = self._samples(step)
        design, target = self._linearised(c, rows)
        if persistence.any():
            # What persists of the error before is no news (Cochrane and Orcutt 1949).
            follows = self._follows[rows]
            design_before, target_before = self._linearised(c, rows[follows] - 1)
            design = design[follows] - persistence @ design_before
            target = target[follows] - target_before @ persistence.T
        return design, target

    def residuals(
        self,
        mean: Array,
        step: int,
        earlier_persistence: Array,
        n_earlier: int,
        least_variance: Array,
    ) -> tuple[Array, Array]:
        """Residuals e (·, K) with the coefficients `mean`, and what persists of the errors, Φ.

        Args:
            mean: coefficients (c, W), (q,).
            step: every so many samples are taken.
            earlier_persistence: Φ of an earlier estimate, (K, K).
            n_earlier: number of its residuals.
            least_variance: of each output, (K,); one that errs by less has no errors that persist.
        """
        rows = self._samples(step)
        errors = self._errors(mean, rows)
        follows = self._follows[rows]
        rows_before = rows[follows] - 1
        # Of consecutive samples the errors before are at hand.
        before = errors[rows_before] if step == 1 else self._errors(mean, rows_before)
        # An output that is known but for its rounding has no errors that could persist.
        has_errors = errors.var(axis=0) > least_variance
        persistence = estimate_persistence(
            errors[follows] * has_errors,
            before * has_errors,
            earlier_persistence,
            n_earlier,
            doubt=self._settings.persistence_doubt,
            largest=self._settings.largest_persistence,
        )
        if persistence.any():
            errors = errors[follows] - before @ persistence.T
        return errors - errors.mean(axis=0), persistence

    def _samples(self, step: int) -> Rows:
        """Every so many samples, from the first one on."""
        return np.arange(0, len(self._inputs), step)

    def _linearised(self, c: Array, rows: Rows) -> tuple[Array, Array]:
        """Design and target of some samples about c, over h."""
        inputs = self._inputs[rows]
        design = self.standardisation.design(self._features, inputs, c)
        # Linear in c: y(c̄) ≈ y(c) + G (c̄ − c), so that what is known stands on one side.
        target = self._outputs[rows] - design.y + design.G @ c
        return design.over_h, target / design.h

    def _errors(self, mean: Array, rows: Rows) -> Array:
        """Errors r (·, K) of some samples with the coefficients `mean`."""
        p = self._features.n_parameters
        c = mean[:p]
        W = mean[p:]
        inputs = self._inputs[rows]
        outputs = self._outputs[rows]
        design = self.standardisation.design(self._features, inputs, c)
        of_nominal = (outputs - design.y) / design.h
        linear_part = design.over_h[:, :, p:] @ W
        errors: Array = of_nominal - linear_part
        return errors


@dataclass(frozen=True)
class EmpiricalModel:
    """The estimate from M transitions.

    Attributes:
        features: the nominal model.
        centre, unit: by which inputs are standardised, (n+m,).
        mean: c, then W row by row for the inputs (1, s, a), standardised, (p + K(1+n+m),).
        covariance: that of the posterior of `mean`.
        residuals: e, (M, K), of mean zero; r itself where it does not persist.
        persistence: Φ, what the next sample keeps of r, (K, K); zero where errors are independent.
    """

    features: Features
    centre: Array
    unit: Array
    mean: Array
    covariance: Array
    residuals: Array
    persistence: Array

    @classmethod
    def fit(
        cls,
        features: Features,
        inputs: Array,
        outputs: Array,
        settings: EmpiricalModelConfiguration,
        earlier: EmpiricalModel | None = None,
        follows: NDArray[np.bool_] | None = None,
    ) -> EmpiricalModel:
        """Estimate from transitions.

        Args:
            features: the nominal model.
            inputs: (s, a), (M, n+m).
            outputs: (s₊, ℓ), (M, K).
            settings: prior and rounds.
            earlier: an earlier estimate, whose residuals are kept beside the new ones, and whose Φ
                counts as if they had been seen here.
            follows: whether each transition begins where the one before ends, (M,); all but the
                first if not given.
        """
        p = features.n_parameters
        K = features.n_outputs
        earlier_residuals = np.empty((0, K))
        earlier_persistence = np.zeros((K, K))
        if earlier is not None:
            earlier_residuals = earlier.residuals
            earlier_persistence = earlier.persistence
        regression = _Regression(features, inputs, outputs, settings, follows)
        largest_error = settings.largest_parameter_error

        # All fits but the last take every `thinning`-th sample.
        thinning = max(len(inputs) // settings.fit_samples, 1)
        y, _, h = features(inputs[::thinning], np.zeros(p))
        nominal_errors = outputs[::thinning] - y
        # The sizes of the nominal model's errors set the widths of W.
        priors = _priors(nominal_errors, y, features, settings)
        relative = y / h
        mean_square = (relative**2).mean(axis=0)
        least_variance = INTEGRATION_ERROR**2 * mean_square

        # Φ begins at that of what the parameters leave, with the slopes of W all but fixed: the
        # errors of a wrong parameter would persist, and wide slopes, fitted to states that
        # persistent errors have moved, would take these for their own.
        independent = np.zeros((K, K))
        before = (earlier_persistence, len(earlier_residuals), least_variance)
        mean = np.zeros(priors[0].size)
        residuals, persistence = regression.residuals(mean, thinning, *before)
        for _ in range(settings.parameter_rounds):
            noise = _residual_covariance(residuals, least_variance)
            design, target = regression.equations(mean[:p], thinning, independent)
            mean, _, _ = _posterior(design, target, noise, priors[-1:])
            # Beyond its largest error a parameter means another plant, not a fit.
            mean[:p] = mean[:p].clip(-largest_error, largest_error)
            residuals, persistence = regression.residuals(mean, thinning, *before)

        steps = [thinning] * (settings.fit_rounds - 1)
        for step in [*steps, 1]:
            # Residuals from before a change help to size the noise of a young regime.
            known = np.concatenate([residuals, earlier_residuals])
            noise = _residual_covariance(known, least_variance)
            # In closed loop no slope can be told from what persists: states and actions follow.
            widths = priors[-1:] if persistence.any() else priors
            # Linearised at the present c: a Gauss-Newton step.
            design, target = regression.equations(mean[:p], step, persistence)
            mean, covariance, _ = _posterior(design, target, noise, widths)
            mean[:p] = mean[:p].clip(-largest_error, largest_error)
            residuals, persistence = regression.residuals(mean, step, *before)

        return cls(
            features=features,
            centre=regression.standardisation.centre,
            unit=regression.standardisation.unit,
            mean=mean,
            covariance=covariance,
            residuals=np.concatenate([residuals, earlier_residuals]),
            persistence=persistence,
        )

    def draws(
        self,
        inputs: Array,
        outputs: Array,
        settings: EmpiricalModelConfiguration,
        count: int,
        rng: np.random.Generator,
        follows: NDArray[np.bool_] | None = None,
        rounds: int = 2,
    ) -> list[EmpiricalModel]:
        """Models from the posterior: each is a fit to outputs and a prior that are moved by chance.

        Draws from the normal law of `mean` would go along directions in which the data show nothing
        to first order alone: at ten per cent of a parameter the second order spoils the predictions
        of these very data. A fit to moved data does not leave them (randomise, then optimise:
        Bardsley et al. 2014).

        Args:
            inputs: (s, a) of the fit, (M, n+m).
            outputs: (s₊, ℓ) of it, (M, K).
            settings: prior of the fit.
            count: number of models.
            rng: draws what data and prior are moved by.
            follows: as in `fit`.
            rounds: Gauss-Newton steps to each model.
        """
        regression = _Regression(self.features, inputs, outputs, settings, follows)
        y, _, _ = self.features(inputs, np.zeros(self.features.n_parameters))
        priors = _priors(outputs - y, y, self.features, settings)
        widths = priors[-1:] if self.persistence.any() else priors
        p = self.features.n_parameters
        relative = outputs / self.features(inputs, self.mean[:p])[2]
        noise = _residual_covariance(
            self.residuals, INTEGRATION_ERROR**2 * (relative**2).mean(axis=0)
        )
        design, target = regression.equations(self.mean[:p], 1, self.persistence)
        _, _, prior = _posterior(design, target, noise, widths)
        largest = settings.largest_parameter_error

        moves = []
        centres = []
        for _ in range(count):
            moves.append(rng.multivariate_normal(np.zeros(len(noise)), noise, len(target)))
            centres.append(prior * rng.standard_normal(prior.size))

        def moved(number: int) -> Array:
            """The target of a model: about its moved centre the prior is the usual one."""
            return target + moves[number] - design @ centres[number]

        def at(number: int, distance: Array) -> Array:
            """Coefficients of a model at a distance from its moved centre, (q,)."""
            mean: Array = centres[number] + distance
            mean[:p] = mean[:p].clip(-largest, largest)
            return mean

        # All models begin at one point, so that the first step has one factorisation.
        targets = [moved(number) for number in range(count)]
        R_design, R_targets = _whitened_triangle(design, targets, noise)
        means = []
        for number in range(count):
            distance, _, _ = _of_triangle(R_design, R_targets[:, number], [prior])
            means.append(at(number, distance))
        models = []
        for number in range(count):
            for _ in range(rounds - 1):
                c = means[number][:p]
                design, target = regression.equations(c, 1, self.persistence)
                distance, _, _ = _posterior(design, moved(number), noise, [prior])
                means[number] = at(number, distance)
            models.append(replace(self, mean=means[number]))
        return models

    def predict(self, inputs: Array) -> tuple[Array, Array, Array]:
        """Predictions at inputs (s, a), (M, n+m).

        Returns:
            (s₊, ℓ) without r and h, (M, K) each, and the predictions' derivative by `mean` over h,
            (M, K, p + K(1+n+m)).
        """
        p = self.features.n_parameters
        W = self.mean[p:]
        design = self._design(inputs)
        over_h = design.over_h
        linear_part = over_h[:, :, p:] @ W
        return design.y + design.h * linear_part, design.h, over_h

    def _design(self, inputs: Array) -> _Design:
        """The model at inputs (M, n+m), linear about its own parameters."""
        c = self.mean[: self.features.n_parameters]
        standardisation = Standardisation(self.centre, self.unit)
        return standardisation.design(self.features, inputs, c)

    def nominal_prediction_error(self, inputs: Array, c: Array) -> Array:
        """Mean one-step prediction error of the nominal model, as this model knows it.

        Args:
            inputs: (s, a), (M, n+m).
            c: errors of the nominal model's parameters, (p,).

        Returns:
            Mean of s₊ − y(s, a; c), (n,).
        """
        y, _, _ = self.features(inputs, c)
        # The model's own prediction stands for the plant's mean.
        predicted, _, _ = self.predict(inputs)
        errors = predicted - y
        of_states = errors[:, :-1]
        mean: Array = of_states.mean(axis=0)
        return mean

    def cost_derivative(self, inputs: Array) -> Array:
        """Derivative of the mean cost at inputs (M, n+m) by `mean`, (p + K(1+n+m),)."""
        # The cost is the last output.
        of_cost = self._design(inputs).rows[:, -1]
        derivative: Array = of_cost.mean(axis=0)
        return derivative

    @cached_property
    def noise(self) -> Array:
        """Covariance of the residuals, (K, K)."""
        return _without_exact_combinations(np.cov(self.residuals.T))

    @property
    def error_covariance(self) -> Array:
        """Covariance of r, (K, K), which is e's where r does not persist."""
        return error_covariance(self.persistence, self.noise)

    @property
    def error_deviation(self) -> Array:
        """Standard deviation of r, (K,)."""
        # The residuals' own deviation, larger by what persists of them.
        growth = np.diag(self.error_covariance) / np.diag(self.noise)
        of_residuals = self.residuals.std(axis=0)
        deviation: Array = of_residuals * np.sqrt(growth)
        return deviation

    def mean_error_covariance(self, count: int) -> Array:
        """Covariance of the mean of so many consecutive r, (K, K)."""
        return mean_error_covariance(self.persistence, self.noise, count)

    def effective_number(self, count: int) -> float:
        """Number of independent errors that would say as much as so many consecutive r."""
        return effective_number(self.persistence, count)

    @property
    def coefficients(self) -> tuple[Array, Array]:
        """c (p,) and W (K, 1+n+m) for inputs in their own units."""
        p = self.features.n_parameters
        c = self.mean[:p]
        n_outputs = self.features.n_outputs
        W = self.mean[p:].reshape(n_outputs, -1)
        # W (1, z) with z = (inputs − centre) / unit.
        slopes = W[:, 1:] / self.unit
        constants = W[:, 0] - slopes @ self.centre
        return c, np.column_stack([constants, slopes])

    def state_dict(self) -> State:
        """All but the features."""
        return {
            "centre": self.centre,
            "unit": self.unit,
            "mean": self.mean,
            "covariance": self.covariance,
            "residuals": self.residuals,
            "persistence": self.persistence,
        }


def pointers(*arrays: NDArray[Any]) -> list[ctypes.c_void_p]:
    """The addresses of arrays, as arguments of a C function."""
    return [ctypes.c_void_p(array.ctypes.data) for array in arrays]


def c_definitions(sizes: Mapping[str, int]) -> str:
    """A `#define` for each size."""
    lines = [f"#define {name} {value}\n" for name, value in sizes.items()]
    return "".join(lines)


def design_rows(G: Array, standardised: Array) -> Array:
    """Rows of the regression: the derivative of the outputs by (c, W).

    Args:
        G: derivative of y by c, (M, K, p).
        standardised: inputs, (M, n+m).

    Returns:
        (M, K, p + K(1+n+m)).
    """
    M, K, p = G.shape
    ones = np.ones(M)
    inputs = np.column_stack([ones, standardised])
    q = inputs.shape[1]
    n_coefficients = p + K * q
    design = np.zeros((M, K, n_coefficients))
    design[:, :, :p] = G
    # Each output has a row of W of its own.
    for i in range(K):
        first = p + i * q
        last = first + q
        design[:, i, first:last] = inputs
    return design


def _residual_covariance(residuals: Array, least_variance: Array) -> Array:
    """Covariance of residuals (M, K), (K, K), each variance at least its least, (K,)."""
    noise: Array = residuals.T @ residuals / len(residuals)
    variance = np.diag(noise)
    # A little in any case, since outputs may be multiples of each other.
    missing = np.maximum(least_variance - variance, 1e-9 * variance)
    noise += np.diag(missing)
    return _without_exact_combinations(noise)


def _without_exact_combinations(covariance: Array) -> Array:
    """Covariance (K, K) in which no combination of outputs is nearly free of errors.

    Where one disturbance moves several states, their errors are nearly multiples of each other. The
    rest is the model's curvature: it follows the state, and its mean is not zero. As noise it would
    be so small that it decided the fit.
    """
    size = np.sqrt(np.diag(covariance))
    unit = np.where(size > 0, size, 1.0)
    correlation = covariance / np.outer(unit, unit)
    eigenvalues, vectors = np.linalg.eigh(correlation)
    missing = np.maximum(LEAST_COMBINATION - eigenvalues, 0.0)
    if not missing.any():
        return covariance
    added = (vectors * missing) @ vectors.T
    floored: Array = covariance + added * np.outer(size, size)
    return floored


def _priors(
    errors: Array,
    y: Array,
    features: Features,
    settings: EmpiricalModelConfiguration,
) -> list[Array]:
    """Prior deviations of (c, W), one array for each width of W's slopes."""
    # Of an output that the nominal model knows exactly, W stays near zero.
    size = np.abs(y).mean(axis=0)
    deviation = errors.std(axis=0) + 1e-9 * size
    parameters = np.full(features.n_parameters, settings.parameter_deviation)
    priors = []
    for slope in sorted(settings.slope_deviations, reverse=True):
        slopes = [slope] * features.n_inputs
        W = np.outer(deviation, [1.0, *slopes])
        priors.append(np.append(parameters, W))
    return priors


def _triangle(rows: Array) -> Array:
    """R (q, q) of the QR factors of rows (M, q), M ≥ q.

    Some outputs are nearly exact, others noisy: normal equations would lose the latter. Blocks that
    fit in a processor's cache are factored first, which takes a third of the time.
    """
    count, q = rows.shape
    n_blocks = count // BLOCK
    n_whole = n_blocks * BLOCK
    whole = rows[:n_whole]
    rest = rows[n_whole:]
    blocks = whole.reshape(n_blocks, BLOCK, q)
    triangles = np.linalg.qr(blocks, mode="r")
    stacked = np.concatenate([*triangles, rest])
    triangle = np.linalg.qr(stacked, mode="r")
    return np.asarray(triangle)


def _posterior(
    design: Array,
    target: Array,
    noise: Array,
    priors: Sequence[Array],
) -> tuple[Array, Array, Array]:
    """Mean and covariance of the coefficients, and the prior deviations, of greatest evidence.

    Args:
        design: (M, K, q).
        target: (M, K).
        noise: covariance of the residuals, (K, K).
        priors: deviations (q,) to choose from.
    """
    R_design, R_targets = _whitened_triangle(design, [target], noise)
    return _of_triangle(R_design, R_targets[:, 0], priors)


def _whitened_triangle(
    design: Array,
    targets: Sequence[Array],
    noise: Array,
) -> tuple[Array, Array]:
    """R of the whitened equations, (·, q), and the targets in its rows, (·, D).

    Args:
        design: (M, K, q).
        targets: D of them, (M, K) each.
        noise: covariance of the residuals, (K, K).
    """
    # Whitened outputs have independent errors of one size.
    whiten = np.linalg.inv(np.linalg.cholesky(noise))
    # An equation for each output of each sample; the targets are their last columns.
    n_coefficients = design.shape[2]
    white_design = whiten @ design
    columns: list[Array] = [white_design.reshape(-1, n_coefficients)]
    for target in targets:
        white_target = target @ whiten.T
        columns.append(white_target.reshape(-1))
    R = _triangle(np.column_stack(columns))
    # Rows below the coefficients' and the targets' own diagonal are zero.
    return R[:, :n_coefficients], R[:, n_coefficients:]


def _of_triangle(
    R_design: Array,
    R_target: Array,
    priors: Sequence[Array],
) -> tuple[Array, Array, Array]:
    """`_posterior` of equations in triangular form, (·, q) and (·,)."""
    greatest = -np.inf
    best: tuple[Array, Array, Array] | None = None
    for prior in priors:
        # The prior as further rows: a ridge regression by QR.
        data_rows = R_design * prior
        prior_rows = np.eye(prior.size)
        all_rows = np.concatenate([data_rows, prior_rows])
        Q, root = np.linalg.qr(all_rows)
        Q_data = Q[: len(R_design)]
        moment = Q_data.T @ R_target
        factor = prior[:, None] * np.linalg.inv(root)
        # Evidence: how well the data are explained, less what the fit could have explained.
        diagonal = np.abs(np.diag(root))
        log_determinant = np.log(diagonal).sum()
        evidence = float(moment @ moment / 2 - log_determinant)
        if best is None or evidence > greatest:
            greatest = evidence
            best = (factor @ moment, factor @ factor.T, prior)
    assert best is not None
    return best
