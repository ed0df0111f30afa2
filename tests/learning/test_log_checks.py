import numpy as np

from learning.log_checks import jumps_there_and_back
from learning.log_configuration import LogConfiguration


def test_a_reading_that_stands_still_has_not_jumped():
    # Sentinels side by side: the model errs by all of the jump, and the reading does not move.
    changes = np.zeros(40)
    changes[[10, 14]] = [-1000.0, 1000.0]
    errors = np.random.default_rng(0).normal(size=40)
    errors[10:15] = [-1000.0, 1000.0, 1000.0, 1000.0, 1000.0]
    follows = np.ones(40, bool)
    jumps = jumps_there_and_back(errors, 0.0, changes, follows, LogConfiguration.of({}))
    assert jumps == [(10, 14)]
