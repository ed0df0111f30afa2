import numpy as np
import pytest
import scipy.stats

from controllers.dynamic_programming import DisturbanceLaw, Refinement

LAWS = {
    "uniform": lambda mean, spread: scipy.stats.uniform(mean - spread, 2 * spread),
    "normal": scipy.stats.norm,
}


@pytest.mark.parametrize("kind", LAWS)
def test_moments_up_to_twice_the_nodes_are_those_of_scipy(kind):
    law = DisturbanceLaw(kind, np.array([1.5]), np.array([0.7]))
    rule = law.rule((5,))
    distribution = LAWS[kind](1.5, 0.7)
    for degree in range(1, 10):
        assert rule.weights @ rule.nodes[:, 0] ** degree == pytest.approx(
            distribution.moment(degree), rel=1e-12
        )


def test_product_rule_integrates_products():
    law = DisturbanceLaw("uniform", np.array([0.0, 2.0]), np.array([1.0, 3.0]))
    rule = law.rule((3, 4))
    x, y = rule.nodes.T
    assert len(rule.weights) == 12
    assert rule.weights.sum() == pytest.approx(1.0, rel=1e-14)
    # E[x²] = 1/3, E[y²] = 4 + 3.
    assert rule.weights @ (x**2 * y**2) == pytest.approx(7 / 3, rel=1e-13)


@pytest.mark.parametrize("kind", ["uniform", "normal", "none"])
def test_draws_have_the_laws_moments(kind):
    law = DisturbanceLaw(kind, np.array([5.0, -1.0]), np.array([1.0, 0.0]))
    draws = law.draw(np.random.default_rng(1), 40_000)
    variance = {"uniform": 1 / 3, "normal": 1.0, "none": 0.0}[kind]
    np.testing.assert_allclose(draws.mean(axis=0), [5.0, -1.0], atol=0.02)
    np.testing.assert_allclose(draws.var(axis=0), [variance, 0.0], atol=0.02)


def test_refinement_reproduces_polynomials_of_the_coarse_degree():
    law = DisturbanceLaw("uniform", np.array([1.0, 2.0, 0.0]), np.array([1.0, 0.5, 2.0]))
    coarse, fine = law.rule((4, 3, 2)), law.rule((9, 8, 5))

    def polynomial(nodes):
        x, y, z = nodes.T
        return np.stack([x**3 * y**2 * z, 1 + x - y * z])

    carried = Refinement(coarse, fine)(polynomial(coarse.nodes))
    np.testing.assert_allclose(carried, polynomial(fine.nodes), rtol=1e-12, atol=1e-12)
