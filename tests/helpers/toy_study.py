"""Studies that take a second: an algorithm that only moves a bound, and short runs."""

from pathlib import Path
from typing import ClassVar

from pydantic import Field

from cosim import Scenario, study
from cosim.core.modules import import_from
from learning.configuration import Configuration
from learning.errors import DivergenceError

HERE = "toy_study"
"""Its name where it is a plug-in: in a folder of its own, so that no other file counts."""
import_from(Path(__file__).parent)
GROW = f"{HERE}:Grow"
SCENARIO = {"extends": "paper", "name": "paper", "controller": {"horizon": 2}}
"""`paper` with a short horizon: its controllers are built in half of the time."""


class ToyConfiguration(Configuration):
    rate: float = Field(1.0, description="what x_l moves in 1000 samples")
    marker: str = Field("", description="file that says that the run was interrupted")
    weights: list[float] = Field([], description="a setting that is a list itself")


class Grow:
    """Moves the lower bounds of θ evenly; explores nothing."""

    Configuration: ClassVar = ToyConfiguration
    requires: ClassVar = "operation"
    needs_q_solution = needs_points = explores = False

    def __init__(self, controller, scenario, configuration, samples, strategy, rng):
        self._controller, self._configuration = controller, configuration

    def observe(self, transition):
        if (transition.number + 1) % 100 == 0:
            theta = self._controller.theta.copy()
            where = self._controller.parameters.blocks.slices["x_l"]
            theta[where] += self._configuration.rate / 10
            self._controller.theta = theta

    def state_dict(self):
        return {}

    def load_state_dict(self, state):
        pass


class Break(Grow):
    def observe(self, transition):
        raise ZeroDivisionError("broken in the middle")


class Diverge(Grow):
    """Diverges at its 201st sample."""

    def observe(self, transition):
        super().observe(transition)
        if transition.number == 200:
            raise DivergenceError("the toy was told to")


class Interrupt(Grow):
    """Is interrupted by the user once, behind its first checkpoint."""

    def observe(self, transition):
        super().observe(transition)
        marker = Path(self._configuration.marker)
        if transition.number == 250 and not marker.exists():
            marker.touch()
            raise KeyboardInterrupt


def case(name, kind="Grow", samples=200, **more):
    return {"name": name, "algorithm": f"{HERE}:{kind}", "samples": samples} | more


def document(**changes):
    return {
        "schema": 1,
        "name": "toy",
        "scenarios": ["paper"],
        "scenario": [SCENARIO],
        "training_seeds": {"first": 0, "count": 2},
        "evaluation": {"seeds": 3, "steps": 30},
        "curves": {"points": 4, "seeds": 2, "steps": 20},
        "case": [case("grow", settings={"rate": [1.0, 2.0]}), {"controller": ["naive", "optimal"]}],
    } | changes


def toy_scenario():
    """The scenario of the studies."""
    return Scenario.load("paper").replace({"controller": SCENARIO["controller"]})


def run_toy(out, *, jobs=1, report=lambda *state: None, **changes):
    """Run the document with some changes."""
    return study(document(**changes), out, jobs=jobs, progress=report)
