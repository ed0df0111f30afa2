"""A neural policy in the benchmark's table: a small network in NumPy, its weights from a file.

cosim evaluate --controllers naive,sac=examples.outsiders.policy:sac
"""

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent
# What the network sees and gives: deviations from the operating point, in these units.
STATE_SCALE = np.array([2.0, 5.0])


def observation(scenario, state):
    return (state - scenario.reference_state) / STATE_SCALE


def action(scenario, normalised):
    """From [-1, 1] to the action box, 0 being its centre."""
    lower, upper = scenario.action_lower, scenario.action_upper
    return lower + 0.5 * (np.clip(normalised, -1.0, 1.0) + 1.0) * (upper - lower)


@dataclass
class Decision:
    """What the closed loop reads of a solution; a network has neither value nor prediction."""

    action: np.ndarray
    value: float = float("nan")
    status: str = "solved"
    residual: float = float("nan")
    predicted_states: None = None
    predicted_actions: None = None


@dataclass(frozen=True)
class Weights:
    """The hash tells the evaluation which network it evaluated."""

    hash: str


class NeuralPolicy:
    """A multilayer perceptron: layers W, b; `tanh` or `relu` between, `tanh` or nothing last."""

    def __init__(self, scenario, path):
        data = np.load(path, allow_pickle=False)
        self._scenario = scenario
        self._layers = [(data[f"W{i}"], data[f"b{i}"]) for i in range(int(data["layers"]))]
        self._between = {"tanh": np.tanh, "relu": lambda x: np.maximum(x, 0.0)}[
            str(data["between"])
        ]
        self._last = np.tanh if str(data["last"]) == "tanh" else lambda x: x
        self.parameters = Weights(hashlib.sha256(Path(path).read_bytes()).hexdigest()[:16])

    def reset(self):
        pass

    def prepare(self):
        pass

    def feedback(self, s, a=None):
        if a is not None:
            return Decision(a)
        x = observation(self._scenario, s)
        for W, b in self._layers[:-1]:
            x = self._between(W @ x + b)
        W, b = self._layers[-1]
        return Decision(action(self._scenario, self._last(W @ x + b)))


def sac(scenario):
    return NeuralPolicy(scenario, FOLDER / "sac.npz")


def ppo(scenario):
    return NeuralPolicy(scenario, FOLDER / "ppo.npz")
