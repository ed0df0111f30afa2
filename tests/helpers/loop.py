"""Small controllers to drive the loop with, in place of an NMPC."""

import numpy as np

from cosim import Decision


class Proportional:
    """u = u_s + gain (x_s − x), with the pressure of steam following the concentration."""

    name = "proportional"

    def __init__(self, scenario, gain=10.0):
        self._scenario = scenario
        self._gain = gain
        self.resets = 0

    def reset(self):
        self.resets += 1

    def prepare(self):
        pass

    def feedback(self, s, a=None):
        error = self._scenario.reference_state - s
        action = self._scenario.reference_action + self._gain * np.array([error[0], 0.0])
        return Decision(action, value=float(error[0]))


class SolverFailed(Exception):
    is_solver_failure = True


class Failing(Proportional):
    """Fails to solve at given samples, in `prepare` or in `feedback`."""

    def __init__(self, scenario, at, phase="feedback"):
        super().__init__(scenario)
        self._at, self._phase, self._k = set(at), phase, -1

    def prepare(self):
        self._k += 1
        if self._phase == "prepare" and self._k in self._at:
            raise SolverFailed("no solution")

    def feedback(self, s, a=None):
        if self._phase == "feedback" and self._k in self._at:
            raise SolverFailed("no solution")
        return super().feedback(s)


def proportional(scenario):
    return Proportional(scenario)


class Hold:
    """Applies one action for ever."""

    def __init__(self, action):
        self._answer = Decision(np.array(action))

    def reset(self):
        pass

    def prepare(self):
        pass

    def feedback(self, s, a=None):
        return self._answer


def hold(scenario):
    return Hold(scenario.reference_action)


class Playback:
    """Applies given actions (K, m), from the first on after each reset."""

    def __init__(self, actions):
        self._actions = np.asarray(actions, dtype=float)
        self._k = -1

    def reset(self):
        self._k = -1

    def prepare(self):
        self._k += 1

    def feedback(self, s, a=None):
        return Decision(self._actions[self._k])
