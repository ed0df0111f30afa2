"""Co-simulation of an FMU plant with a controller: scenarios, closed loop, records, results."""

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from cosim.control import Parameters as Parameters
    from cosim.control import build_controller as build_controller
    from cosim.core.protocols import Decision as Decision
    from cosim.core.scenario import Scenario as Scenario
    from cosim.core.simulation import simulate as simulate
    from cosim.core.trajectory import Trajectory as Trajectory
    from cosim.core.version import __version__ as __version__
    from cosim.evaluation import Evaluation as Evaluation
    from cosim.evaluation import evaluate as evaluate
    from cosim.plant import FmuPlant as FmuPlant
    from cosim.studies.definition import Study as Study
    from cosim.studies.results import StudyResults as StudyResults
    from cosim.studies.results import study as study
    from cosim.training import Training as Training
    from cosim.training import train as train

# Imported on first use: `cosim --help` must not pay for NumPy, pydantic and fmpy.
__getattr__, __dir__, __all__ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "control": ["Parameters", "build_controller"],
        "core.protocols": ["Decision"],
        "core.scenario": ["Scenario"],
        "core.simulation": ["simulate"],
        "core.trajectory": ["Trajectory"],
        "core.version": ["__version__"],
        "evaluation": ["Evaluation", "evaluate"],
        "plant": ["FmuPlant"],
        "studies.definition": ["Study"],
        "studies.results": ["StudyResults", "study"],
        "training": ["Training", "train"],
    },
)


def _refuse_shadows() -> None:
    """Raise ImportError where a user's file or folder has the name of one of our packages."""
    root = Path(__file__).parents[1].resolve()
    for name in ("controllers", "fmus", "learning"):
        spec = find_spec(name)
        assert spec is not None
        # A folder without __init__.py has no origin.
        origin = spec.origin
        if origin is None or Path(origin).resolve().parents[1] != root:
            place = origin or next(iter(spec.submodule_search_locations or ()), name)
            line = (
                f"'{place}' hides the package '{name}' of rti-cosim: rename it, or start Python "
                "in another folder"
            )
            # `python -m cosim` is a command: one line, no traceback.
            if sys.argv[:1] == ["-m"]:
                print(f"error: {line}", file=sys.stderr)
                raise SystemExit(2)
            raise ImportError(line)


# A script's own folder is searched first, so that a file `learning.py` beside it is imported.
_refuse_shadows()
