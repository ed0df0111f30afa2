"""The tables of a study file, each with its fields, types and ranges."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from cosim.core.errors import StudyError
from cosim.core.files import read_toml
from cosim.core.scenario import Table
from cosim.core.validation import SchemaVersion, validated

RunCount = Annotated[int, Field(ge=1, le=100_000_000)]
Seed = Annotated[int, Field(ge=0)]
# A name is a file's, too: no separator, no blank, and not of dots alone.
StudyName = Annotated[str, Field(pattern=r"^\.*[\w+-][\w.+-]*$")]
Source = Annotated[str, Field(min_length=1)]
PerScenario = RunCount | dict[str, RunCount]
"""One number for all scenarios, or one for each by its name; `default` is that of the others."""
DEFAULT = "default"
FOR_ALGORITHMS = {
    "samples",
    "start",
    "nmpc",
    "settings",
    "training",
    "training_seeds",
}
"""Fields of a case that a controller has no use for."""
Hour = Annotated[float, Field(gt=0.0, le=1e6)]
Hours = Annotated[list[Hour], Field(min_length=1)]


class SeedsTable(Table):
    """Training seeds: `count` of them from `first` on."""

    first: Seed = 0
    count: RunCount = 10


class EvaluationTable(Table):
    """Noise on which controllers and learned θ are compared, the same for all of them."""

    first_seed: Seed = 100_000
    """First noise seed; no training and no curve may meet it."""
    seeds: PerScenario = 100
    """Number of noise seeds: violations are rare and dear, so that few seeds rank nothing."""
    steps: PerScenario = 2500
    """Samples on each."""
    burn_in: Annotated[int, Field(ge=0, le=100_000_000)] = 0
    """Samples run before those that count: with 0 the run starts at the plant's initial state."""


class CurvesTable(Table):
    """Learning curves: greedy evaluations of θ while training goes on.

    In operation it may be left out: θ is then evaluated on the noise of `[evaluation]`.
    """

    points: RunCount = 20
    """Greedy evaluations of each training, evenly over its samples."""
    seeds: PerScenario = 4
    """Held-out runs of each evaluation."""
    steps: PerScenario = 500
    """Samples of each of them."""


class OperationTable(Table):
    """Learning in operation: every training runs from one plant sample to the next, without reset.

    Its θ is evaluated greedily at the given times, on the plant as it is then. The noise is that
    of `[evaluation]`, or of `[curves]` where the file has that table. Algorithms require
    `operation`; the last time is the length of every run.
    """

    hours: Hours | dict[str, Hours]
    """Times in hours of operation, for all scenarios or by a scenario's name, with `default`."""
    columns: list[Hour] = []
    """Those of them that tables show; all, if left out."""
    drawn: list[Source] = []
    """Cases that the figure shows; all, if left out."""


class CaseTable(Table):
    """A table `[[case]]`: an algorithm to train, or a controller to evaluate as it is.

    In `settings`, and for `samples`, `start` and `nmpc`, a list stands for a grid; where a setting
    takes a list itself, a list of lists does.
    """

    name: StudyName | None = None
    """Its name in tables; by default the controller's own."""
    algorithm: Source | None = None
    """A registered algorithm, or `module:Class`."""
    controller: Source | list[Source] | None = None
    """A registered controller, `module:factory` or a parameters file; a list is several cases."""
    samples: RunCount | list[RunCount] = 40_000
    """Plant samples of a training."""
    start: Source | list[Source] = "naive"
    """θ at the start: `naive`, `tuned`, `backed-off`, `cautious` or a parameters file."""
    nmpc: Literal["rti", "converged"] | list[Literal["rti", "converged"]] = "rti"
    """NMPC that carries θ: real-time iteration or converged."""
    settings: dict[str, Any] = {}
    """The algorithm's hyperparameters."""
    training: dict[str, Any] = {}
    """Options of the training loop, by their names in `cosim train`."""
    scenarios: list[Source] | None = None
    """Those of the study's scenarios that it runs on; all, if left out."""
    training_seeds: SeedsTable | None = None
    """Its own training seeds, in place of the study's."""
    group: StudyName | None = None
    """Panel of the figures that shows it; by default the algorithm's name."""
    title: str = ""
    """A few words for readers."""
    against: Source | None = None
    """Name of the case that this one's paired difference is taken from; in a grid, that of the
    same point where there is one."""

    @model_validator(mode="after")
    def _is_one_of_two(self) -> Self:
        if (self.algorithm is None) == (self.controller is None):
            raise ValueError(f"{self._where()}: needs either algorithm or controller")
        if self.algorithm is not None and self.name is None:
            raise ValueError(f"{self._where()}: a case with an algorithm needs a name")
        # Their defaults are harmless beside a controller; what is written has no effect.
        set_in_vain = self.model_fields_set & FOR_ALGORITHMS
        if self.controller is not None and set_in_vain:
            names = ", ".join(sorted(set_in_vain))
            raise ValueError(
                f"{self._where()}: {names} is for an algorithm; a controller is evaluated without "
                "training"
            )
        return self

    def _where(self) -> str:
        return f"case '{self.name or self.algorithm or self.controller or ''}'"


class TrajectoryTable(Table):
    """A table `[[trajectory]]`: one run of each case on the same noise, kept sample by sample."""

    name: StudyName
    """Its name in files and figures."""
    seed: Seed = 1
    """Noise seed."""
    steps: RunCount = 240
    """Samples of the run."""
    cases: list[Source] | None = None
    """Names of cases; a trained one runs with its first training seed. All, if left out."""
    scenarios: list[Source] | None = None
    """Those of the study's scenarios that it is of; all, if left out."""
    figures: list[Literal["trajectory", "overlay", "density", "phase"]] = []
    """Kinds of figures of the runs."""

    @property
    def file(self) -> str:
        """Name of the file in a run's folder."""
        return f"trajectory-{self.name}-{self.seed}-{self.steps}.csv"


class StudyTable(Table):
    """A study file."""

    schema_version: Annotated[SchemaVersion, Field(alias="schema")]
    """`schema` in the file: 1."""
    name: StudyName
    """The study's name in tables and messages."""
    title: str = ""
    """Heading of the report; the name, if left out."""
    description: str = ""
    """A paragraph for readers."""
    depends_on: list[Source] = []
    """Data files that plug-ins read, relative to the study's file: edited, their runs are anew."""
    scenarios: Annotated[list[Source], Field(min_length=1)]
    """Presets, scenario files, or names of the file's own `[[scenario]]` tables."""
    scenario: list[dict[str, Any]] = []
    """Scenarios with the content of scenario files, `extends` included."""
    training_seeds: SeedsTable = SeedsTable()
    """Table `[training_seeds]`: those of every case that has none of its own."""
    evaluation: EvaluationTable = EvaluationTable()
    """Table `[evaluation]`."""
    curves: CurvesTable = CurvesTable()
    """Table `[curves]`."""
    operation: OperationTable | None = None
    """Table `[operation]`: runs are judged at given times of operation."""
    case: Annotated[list[CaseTable], Field(min_length=1)]
    """Tables `[[case]]`."""
    trajectory: list[TrajectoryTable] = []
    """Tables `[[trajectory]]`."""
    logs: list[Source] = []
    """Trained cases whose log and θ are kept beside the tables, and drawn: first training seed."""
    tables: list[Literal["paper"]] = []
    """Further tables of the report: `paper` holds the paper's figures beside ours."""
    check: bool = False
    """Whether `cosim results check` runs it, where it is one of a folder of stored studies."""


def read(path: str | Path) -> StudyTable:
    """Read and validate a study file; raises StudyError with file, field and allowed values."""
    origin = f"study file '{path}'"
    return validated(StudyTable, read_toml(path, origin, StudyError), origin, StudyError)
