import numpy as np
import pytest

from controllers import sdp


def random_symmetric(rng, size):
    root = rng.normal(size=(size, size))
    return root + root.T


@pytest.mark.parametrize("size", [1, 2, 4])
def test_svec_keeps_the_inner_product(rng, size):
    a, b = random_symmetric(rng, size), random_symmetric(rng, size)
    assert sdp.svec(a) @ sdp.svec(b) == pytest.approx(np.trace(a @ b), rel=1e-13)


def test_the_nearest_semidefinite_matrix_is_the_clipped_one(rng):
    size = 4
    target = random_symmetric(rng, size)
    count = size * (size + 1) // 2
    x, status = sdp.solve(
        np.eye(count), -sdp.svec(target), -np.eye(count), np.zeros(count), [sdp.semidefinite(size)]
    )
    values, vectors = np.linalg.eigh(target)
    clipped = (vectors * np.maximum(values, 0.0)) @ vectors.T
    assert status == "Solved"
    np.testing.assert_allclose(x, sdp.svec(clipped), atol=1e-6)
