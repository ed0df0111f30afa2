"""Rollouts in two languages."""

import numpy as np
import pytest

from learning.rollout import Rollout
from tests.helpers.compiler import needs_compiler


@pytest.mark.slow  # compiles the controller
@needs_compiler
def test_both_rollouts_are_one(problem, tuned_theta, features, fitted, rng, monkeypatch):
    monkeypatch.setenv("COSIM_COMPILE", "now")
    rollout = Rollout(problem, tuned_theta, features)
    assert rollout.compiled is not None
    lower = tuned_theta["x_l"]
    bounds = [lower + np.array([delta, 0.0]) for delta in (0.0, 2.0, 3.0)]
    thetas = [tuned_theta.replace({"x_l": bound}).theta for bound in bounds]
    picks = rng.integers(2000, size=40, dtype=np.int32)
    compiled = rollout(thetas, np.array([30.0, 78.0]), fitted, picks)
    rollout.compiled = None
    interpreted = rollout(thetas, np.array([30.0, 78.0]), fitted, picks)
    for one, other in zip(compiled, interpreted, strict=True):
        for part, like in zip(one, other, strict=True):
            assert np.allclose(part, like, rtol=1e-9, atol=0.0)
