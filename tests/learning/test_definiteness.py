import numpy as np
import pytest

from controllers.theta import Parameters, ThetaBlocks
from learning.errors import DefinitenessError
from learning.step import (
    CholeskyParametrisation,
    Fit,
    LinearMatrixInequality,
    certificate,
    clip_eigenvalues,
    matrix_of,
    td_fit,
)

SMALLEST = 1e-2
KINDS = (LinearMatrixInequality, CholeskyParametrisation)


@pytest.fixture(scope="module")
def blocks(problem):
    return ThetaBlocks.of(problem)


def fit_towards(target, metric):
    return Fit(metric @ target, target, lambda: metric)


def random_fit(blocks, rng, size=5.0):
    root = rng.normal(size=(blocks.size, blocks.size))
    return fit_towards(size * rng.normal(size=blocks.size), root @ root.T + np.eye(blocks.size))


def projected_gradient(blocks, theta, fit, rounds=2000):
    """The constrained fit by Frobenius projections: slow, and nothing in common with Clarabel."""
    weight = 1.0 / blocks.scale
    for name in ("B_l", "B_Vf"):
        size = blocks.block(name).dimension
        rows, columns = np.triu_indices(size)
        weight[blocks.slices[name]] = np.where(rows == columns, 1.0, np.sqrt(2.0))
    # In y = weight · scale · d a block's norm is Frobenius's, so clipping is the projection.
    unit = weight * blocks.scale
    metric = fit.metric() / np.outer(unit, unit)
    gradient = fit.gradient / unit
    y = np.zeros(blocks.size)
    z, momentum = y.copy(), 1.0
    length = 1.0 / np.linalg.eigvalsh(metric)[-1]
    for _ in range(rounds):
        moved = theta + (z - length * (metric @ z - gradient)) / weight
        new = (clip_eigenvalues(blocks, moved, SMALLEST) - theta) * weight
        following = (1 + np.sqrt(1 + 4 * momentum**2)) / 2
        z, y, momentum = new + (momentum - 1) / following * (new - y), new, following
    return theta + y / weight


def objective(blocks, theta, new, fit):
    d = (new - theta) / blocks.scale
    return d @ fit.metric() @ d - 2 * fit.gradient @ d


@pytest.mark.parametrize("kind", KINDS)
def test_every_step_is_definite_and_certified(blocks, parameters, rng, kind):
    enforce = kind(blocks, SMALLEST)
    theta = parameters.theta
    corrected = 0
    for _ in range(30):
        new, vouched = enforce(theta, random_fit(blocks, rng))
        assert vouched.smallest >= SMALLEST * (1 - 1e-9)
        assert vouched.smallest == pytest.approx(certificate(blocks, new).smallest)
        assert not vouched.refused
        corrected += vouched.corrected
    assert corrected > 20


def test_a_free_step_that_is_definite_is_taken_as_it_is(blocks, parameters, rng):
    fit = random_fit(blocks, rng, size=1e-3)
    new, vouched = LinearMatrixInequality(blocks, SMALLEST)(parameters.theta, fit)
    assert np.array_equal(new, parameters.theta + blocks.scale * fit.minimiser)
    assert not vouched.corrected


def test_cholesky_takes_a_small_step_to_first_order(blocks, parameters, rng):
    enforce = CholeskyParametrisation(blocks, SMALLEST)
    errors = []
    for size in (1e-2, 1e-3):
        fit = random_fit(blocks, np.random.default_rng(1), size)
        new, _ = enforce(parameters.theta, fit)
        free = parameters.theta + blocks.scale * fit.minimiser
        errors.append(np.abs(new - free).max())
    # Second order: a tenth of the step leaves a hundredth of the error (and the tiny floor).
    assert errors[1] < 0.012 * errors[0] + 1e-8


def test_cholesky_does_not_follow_a_step_far_beyond_the_present_hessian(blocks, parameters, rng):
    enforce = CholeskyParametrisation(blocks, SMALLEST)
    fit = random_fit(blocks, rng, size=1e4)
    new, vouched = enforce(parameters.theta, fit)
    assert vouched.smallest >= SMALLEST
    for name in ("B_l", "B_Vf"):
        before, after = (matrix_of(blocks, theta, name) for theta in (parameters.theta, new))
        # ‖Φ(X)‖ ≤ √(n/2) for ‖X‖₂ = 1
        most = (1 + np.sqrt(len(before) / 2)) ** 2
        assert np.linalg.norm(after, 2) <= 1.01 * most * np.linalg.norm(before, 2)


def test_lmi_step_equals_a_generic_conic_solution(blocks, parameters, rng):
    theta = parameters.theta
    for _ in range(3):
        root = rng.normal(size=(blocks.size, blocks.size)) / np.sqrt(blocks.size)
        metric = root @ root.T + 0.3 * np.eye(blocks.size)
        fit = fit_towards(2.0 * rng.normal(size=blocks.size), metric)
        new, vouched = LinearMatrixInequality(blocks, SMALLEST)(theta, fit)
        assert vouched.corrected
        reference = projected_gradient(blocks, theta, fit)
        assert objective(blocks, theta, new, fit) == pytest.approx(
            objective(blocks, theta, reference, fit), rel=1e-6
        )
        assert (new - reference) / blocks.scale == pytest.approx(0.0, abs=1e-4)


def test_lmi_step_of_the_papers_fit_keeps_its_scale(blocks, parameters, rng):
    gradient = 1e4 * rng.normal(size=blocks.size)
    fit = td_fit(-1e6, gradient, 10.0)
    new, vouched = LinearMatrixInequality(blocks, SMALLEST)(parameters.theta, fit)
    assert vouched.corrected and not vouched.refused
    assert np.isfinite(new).all()
    assert objective(blocks, parameters.theta, new, fit) <= 0.0


def test_projection_is_the_nearest_definite_matrix(blocks, parameters):
    matrix = np.diag([1.0, -1.0, 2.0, 0.5])
    theta = parameters.replace({"B_l": matrix}).theta
    clipped = matrix_of(blocks, clip_eigenvalues(blocks, theta, SMALLEST), "B_l")
    assert clipped == pytest.approx(np.diag([1.0, SMALLEST, 2.0, 0.5]))


def test_cholesky_refuses_an_indefinite_start(blocks, problem, rng):
    theta = Parameters.naive(problem).replace({"B_Vf": np.diag([1.0, -1.0])}).theta
    with pytest.raises(DefinitenessError):
        CholeskyParametrisation(blocks, SMALLEST)(theta, random_fit(blocks, rng))
