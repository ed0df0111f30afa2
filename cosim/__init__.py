"""Co-simulation of an FMU plant with a controller: scenarios, closed loop, records, results."""

from typing import TYPE_CHECKING

from cosim.lazy import on_first_use
from cosim.registration import register_environments

if TYPE_CHECKING:
    from cosim.evaluation import Evaluation as Evaluation
    from cosim.evaluation import evaluate as evaluate
    from cosim.plant import FmuPlant as FmuPlant
    from cosim.scenario import Scenario as Scenario
    from cosim.simulation import simulate as simulate
    from cosim.study.engine import Study as Study
    from cosim.study.outcome import StudyOutcome as StudyOutcome
    from cosim.study.outcome import run_study as run_study
    from cosim.study.results import StudyResults as StudyResults
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
        "Study": "cosim.study.engine",
        "StudyOutcome": "cosim.study.outcome",
        "StudyResults": "cosim.study.results",
        "simulate": "cosim.simulation",
        "run_study": "cosim.study.outcome",
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
    "run_study",
    "simulate",
]


register_environments()
