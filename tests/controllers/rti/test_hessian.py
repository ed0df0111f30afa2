import casadi as ca
import numpy as np
import pytest

from controllers import ThetaBlocks
from controllers.model import discretise
from controllers.preparation import HESSIANS, Exact, Spectrum, preparation
from tests.helpers.sampling import evaporator_problem, random_parameters, random_point

N, n, m = 10, 2, 2
DISCOUNTS = 0.99 ** np.arange(N)


@pytest.fixture(scope="module")
def blocks():
    return ThetaBlocks.from_problem(evaporator_problem())


@pytest.fixture(scope="module")
def prepared(blocks):
    return preparation(evaporator_problem(), blocks)


def filled(name, prepared, blocks, problem, parameters, point):
    rule = HESSIANS[name.removesuffix("-unlifted")](problem, blocks, prepared)
    rule.lifts = not name.endswith("-unlifted")
    rule.set_parameters(parameters)
    constant = rule.fill(*point)
    L, q = (prepared.inputs[part].reshape(N, n + m, -1).copy() for part in ("L", "q"))
    both, cost = problem.scale.both, problem.scale.cost
    return rule, L / np.outer(both, both) * cost, q[:, :, 0] / both * cost, constant


def lift(matrix, floor):
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.maximum(values, floor)) @ vectors.T


def spectrum_of(matrix, floor):
    values, vectors = np.linalg.eigh(matrix[None])
    return Spectrum(values, vectors, np.array([[floor]]), np.ones(len(matrix)))


def lift_in_units(matrix, floor, scale):
    """The lift of the block over the ranges of (x, u) and relative to the level of the cost."""
    metric = np.outer(scale.ranges, scale.ranges) / scale.level
    return lift(matrix * metric, floor) / metric


def test_gauss_newton_is_the_discounted_cost_itself(prepared, blocks, problem, rng):
    parameters = random_parameters(problem, blocks, rng)
    _, L, q, constant = filled(
        "gauss-newton", prepared, blocks, problem, parameters, random_point(problem, rng)
    )
    for k in range(N):
        np.testing.assert_allclose(L[k], 2 * DISCOUNTS[k] * parameters["B_l"], rtol=1e-14)
        np.testing.assert_allclose(q[k], DISCOUNTS[k] * parameters["b_l"], rtol=1e-14)
    assert constant == 0.0
    end, scale = 0.99**N, problem.scale
    slope = scale.state / scale.cost
    np.testing.assert_allclose(
        prepared.inputs["L_N"].reshape(n, n),
        2 * end * parameters["B_Vf"] * np.outer(slope, scale.state),
        rtol=1e-14,
    )
    np.testing.assert_allclose(prepared.inputs["q_N"], end * parameters["b_Vf"] * slope, rtol=1e-14)


def test_exact_unlifted_is_the_hessian_of_the_stage_lagrangian(prepared, blocks, problem, rng):
    parameters, point = random_parameters(problem, blocks, rng), random_point(problem, rng)
    _, L, _, _ = filled("exact-unlifted", prepared, blocks, problem, parameters, point)
    model = problem.model
    x, u, d, p = model.symbols()
    chi = ca.SX.sym("chi", n)
    f = discretise(model, problem.sampling_time, problem.substeps)
    hessian, _ = ca.hessian(ca.dot(chi, f(x, u, d, p)), ca.vertcat(x, u))
    curvature = ca.Function("curvature", [x, u, d, p, chi], [hessian])
    for k in range(N):
        D = curvature(
            point.x[k], point.u[k], model.nominal_disturbance, model.nominal_parameters,
            point.costates[k],
        )  # fmt: skip
        expected = 2 * DISCOUNTS[k] * parameters["B_l"] + np.array(D)
        np.testing.assert_allclose(L[k], expected, rtol=1e-9, atol=1e-9)


def test_exact_lifts_only_what_is_below_the_floor(prepared, blocks, problem, rng):
    parameters, point = random_parameters(problem, blocks, rng), random_point(problem, rng)
    point.costates[:5] *= -300
    _, raw, _, _ = filled("exact-unlifted", prepared, blocks, problem, parameters, point)
    _, L, _, _ = filled("exact", prepared, blocks, problem, parameters, point)
    scale = problem.scale
    metric = np.outer(scale.ranges, scale.ranges) / scale.level
    least = np.linalg.eigvalsh(raw * metric)[:, 0]
    assert (least < 0).any(), "the test needs indefinite blocks"
    assert (least > Exact.FLOOR).any(), "the test needs definite blocks"
    for k in range(N):
        expected = lift_in_units(raw[k], Exact.FLOOR * DISCOUNTS[k], scale)
        np.testing.assert_allclose(L[k], expected, atol=1e-10)
    assert (np.linalg.eigvalsh(L * metric)[:, 0] >= 0.999 * Exact.FLOOR * DISCOUNTS).all()


@pytest.mark.parametrize("name", ["exact", "exact-unlifted"])
def test_the_model_of_the_cost_touches_it_at_the_point(name, prepared, blocks, problem, rng):
    parameters, point = random_parameters(problem, blocks, rng), random_point(problem, rng)
    _, L, q, constant = filled(name, prepared, blocks, problem, parameters, point)
    w = np.concatenate([point.x, point.u], axis=1)
    w -= np.concatenate([problem.reference_state, problem.reference_action])
    B, b = parameters["B_l"], parameters["b_l"]
    true = (DISCOUNTS * (np.einsum("ki,ij,kj->k", w, B, w) + w @ b)).sum()
    model = constant + (np.einsum("ki,kij,kj->k", w, L, w) / 2 + (q * w).sum(axis=1)).sum()
    assert model == pytest.approx(true, rel=1e-11)
    gradient = np.einsum("kij,kj->ki", L, w) + q
    np.testing.assert_allclose(gradient, DISCOUNTS[:, None] * (2 * w @ B + b), rtol=1e-9, atol=1e-8)


@pytest.mark.parametrize("floor", [-3.0, 0.1, 50.0])
def test_contract_is_the_adjoint_of_the_derivative_of_the_lift(floor, rng):
    for _ in range(20):
        X, dX, seed = rng.normal(size=(3, 4, 4))
        X, dX, seed = X + X.T, dX + dX.T, seed + seed.T
        M = spectrum_of(X, floor).contract(seed[None])[0]
        h = 1e-3

        def slope(h, X=X, dX=dX):
            return (lift(X + h * dX, floor) - lift(X - h * dX, floor)) / (2 * h)

        derivative = (4 * slope(h / 2) - slope(h)) / 3
        scale = np.abs(seed).max() * np.abs(dX).max()
        assert (M * dX).sum() == pytest.approx(
            (seed * derivative).sum(), rel=1e-7, abs=1e-8 * scale
        )


def test_contract_holds_for_repeated_eigenvalues(rng):
    # P is the identity above the floor and constant below it, also where eigenvalues coincide.
    seed = rng.normal(size=(4, 4))
    seed = seed + seed.T
    above = spectrum_of(2 * np.eye(4), 1.0).contract(seed[None])[0]
    below = spectrum_of(np.eye(4) / 2, 1.0).contract(seed[None])[0]
    np.testing.assert_allclose(above, seed, atol=1e-15)
    np.testing.assert_allclose(below, 0, atol=1e-15)
