"""Co-simulation of an FMU plant with a controller: scenarios, closed loop, records, results."""

from typing import TYPE_CHECKING

from cosim.lazy import on_first_use
from cosim.registration import register_environments

if TYPE_CHECKING:
    from cosim.evaluation import Evaluation as Evaluation
    from cosim.evaluation import evaluate as evaluate
    from cosim.experiments.outcome import StudyOutcome as StudyOutcome
    from cosim.experiments.outcome import study as study
    from cosim.experiments.results import StudyResults as StudyResults
    from cosim.experiments.study import Study as Study
    from cosim.plant import FmuPlant as FmuPlant
    from cosim.scenario import Scenario as Scenario
    from cosim.simulation import simulate as simulate
    from cosim.trajectory import Trajectory as Trajectory

# Imported on first use: `cosim --help` must not pay for NumPy, pydantic and fmpy.
__getattr__, __dir__ = on_first_use(
    __name__,
    {
        "Evaluation": "cosim.evaluation",
        "evaluate": "cosim.evaluation",
        "FmuPlant": "cosim.plant",
        "Scenario": "cosim.scenario",
        "Trajectory": "cosim.trajectory",
        "Study": "cosim.experiments.study",
        "StudyOutcome": "cosim.experiments.outcome",
        "StudyResults": "cosim.experiments.results",
        "simulate": "cosim.simulation",
        "study": "cosim.experiments.outcome",
    },
)

__all__ = [
    "Evaluation",
    "FmuPlant",
    "Scenario",
    "Study",
    "StudyOutcome",
    "StudyResults",
    "Trajectory",
    "evaluate",
    "simulate",
    "study",
]


register_environments()
