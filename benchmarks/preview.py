"""A sample of the RTI-NMPC that is told a signal's preview, beside the same without signals.

Both compiled, at the states of one closed loop, in turns: `-s prices`, `set-point` or `forecast`.
"""

from benchmarks.measuring import clock, figure
from controllers import compile_functions
from controllers.factories import naive, nmpc
from cosim import FmuPlant, Scenario, simulate
from cosim.core.errors import ScenarioError
from cosim.core.signals import Signals

AT_MOST = 1.1
"""Times as long as the RTI-NMPC alone that a sample with a preview may take."""
ALONE = "paper"
WARM_UP = 100
TURN = 50
"""Samples of a controller before it is the other one's turn."""


def measure(scenario, steps):
    """A row: prepare and feedback with a preview, which is made beforehand, and without."""
    if not scenario.signals:
        raise ScenarioError(f"scenario '{scenario.name}' has no signals: give -s prices")
    without = Scenario.load(ALONE)
    controllers = {"preview": nmpc(scenario, naive(scenario).parameters)}
    controllers["alone"] = nmpc(without, naive(without).parameters)
    for controller in controllers.values():
        compile_functions(controller)
    with FmuPlant(without) as plant:
        states = simulate(plant, naive(without), steps + WARM_UP, 0).states
    signals = Signals(scenario)
    with FmuPlant(scenario) as plant:
        signals.foresee(plant, 0, steps + WARM_UP)
    known = [signals.known(k) for k in range(steps + WARM_UP)]
    seconds = {name: [] for name in controllers}
    for first in range(0, steps + WARM_UP, TURN):
        for name, controller in controllers.items():
            for k in range(first, min(first + TURN, steps + WARM_UP)):
                spent = sample(controller, states[k], known[k] if name == "preview" else None)
                if k >= WARM_UP:
                    seconds[name].append(spent)
    title = f"prepare + feedback with the preview of {scenario.name}"
    row = figure(title, seconds["preview"], "without signals", seconds["alone"])
    return [row | {"at_least_ratio": 1 / AT_MOST, "met": row["ratio"] >= 1 / AT_MOST}]


def sample(controller, s, known):
    """Seconds of one sample."""
    begin = clock()
    if known is not None:
        controller.inform(known)
    controller.prepare()
    controller.feedback(s)
    return clock() - begin
