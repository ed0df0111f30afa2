"""Q(s, a) where the enforced action puts the next state exactly on its bound."""

import numpy as np
import pytest

from controllers.qp import multipliers_at_kink
from tests.helpers.scalar import scalar_qp, solution
from tests.helpers.stored import prepared

FREE = np.array([-10.0]), np.array([10.0])


def enforced(f, v):
    qp = scalar_qp(f)
    qp.lower[:] = qp.upper[:] = v
    return qp


def test_away_from_the_kink_nothing_changes():
    qp = enforced(-3.0, 2.0)
    before = solution(2.0, -2.0, 3.0)
    assert multipliers_at_kink(qp, before, *FREE) is before


@pytest.mark.parametrize("lam", [0.0, 0.3, 1.0])
def test_at_the_policy_the_multipliers_are_those_of_the_value(lam):
    # f = −1.5: the policy is v = 1 with λ = 0.5, ν = 0; any λ in [0, 1] solves Q(s, 1).
    settled = multipliers_at_kink(enforced(-1.5, 1.0), solution(1.0, 0.5 - lam, lam), *FREE)
    np.testing.assert_allclose(np.ravel(settled), [1.0, 0.0, 0.5], atol=1e-15)


@pytest.mark.parametrize(
    ("f", "expected"),
    [
        (-3.0, (1.0, 1.0, 1.0)),  # the policy lies above: one more unit of a gains 1
        (0.5, (1.0, -1.5, 0.0)),  # the policy lies below
    ],
)
def test_elsewhere_the_multipliers_stay_within_their_range(f, expected):
    settled = multipliers_at_kink(enforced(f, 1.0), solution(1.0, -f - 1.0 - 0.3, 0.3), *FREE)
    np.testing.assert_allclose(np.ravel(settled), expected, atol=1e-15)


def test_the_action_gradient_lies_between_the_one_sided_derivatives():
    checked = 0
    for nmpc, qp in prepared("daqp", range(0, 480, 8)):
        policy = nmpc.feedback(qp.s)
        at = nmpc.feedback(qp.s, policy.action)
        if at.licq:
            continue
        checked += 1
        for i in range(2):
            step = np.zeros(2)
            step[i] = 1e-5
            ahead = (nmpc.action_value(qp.s, policy.action + step) - at.value) / 1e-5
            behind = (at.value - nmpc.action_value(qp.s, policy.action - step)) / 1e-5
            slack = 1e-3 * max(1.0, abs(ahead), abs(behind))
            assert behind - slack <= at.action_gradient[i] <= ahead + slack
    assert checked > 5
