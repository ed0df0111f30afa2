"""The experiments of a results folder and the tolerance of each signal, as TOML documents."""

from __future__ import annotations

import shlex
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from cosim.errors import ResultsError
from cosim.validation import describe, suggestion

EXPERIMENTS, TOLERANCES = "experiments.toml", "tolerances.toml"
Text = Annotated[str, Field(min_length=1)]


class _Table(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Experiment(_Table):
    """One stored table and how to make it.

    `runs` maps a label to a `cosim` command without `--out`; the runs' files `table` become one
    tidy table with the label in the column `run`. `keys` name the columns that tell its rows
    apart, `drop` those that are no results (text, hashes). `quick`: `cosim results check`
    recomputes it. `files` are copied from each run's folder as they are, `figures` are drawn.
    """

    title: Text
    description: str = ""
    quick: bool = False
    runs: dict[Text, Text] = Field(min_length=1)
    table: Text
    keys: tuple[Text, ...] = Field(min_length=1)
    drop: tuple[Text, ...] = ()
    files: tuple[Text, ...] = ()
    figures: tuple[
        Literal["trajectory", "overlay", "density", "phase", "pareto", "learning"], ...
    ] = ()

    def command(self, label: str) -> list[str]:
        """Words of a run's command after `cosim`; raises ResultsError where it is no such thing."""
        words = shlex.split(self.runs[label])
        if len(words) < 2 or words[0] != "cosim" or "--out" in words or "-o" in words:
            raise ResultsError(
                f"'{self.runs[label]}' is not a command of the form 'cosim COMMAND …' without --out"
            )
        return words[1:]


class Tolerance(_Table):
    """The largest difference of a signal that counts as none, in the signal's unit."""

    absolute: Annotated[float, Field(ge=0)]
    unit: str


class _Experiments(_Table):
    experiment: dict[Text, Experiment] = Field(min_length=1)


class _Tolerances(_Table):
    tolerance: dict[Text, Tolerance]


def stored_results() -> Path:
    """Folder of this version's results: an installed wheel's, else the checkout's."""
    package = Path(__file__).parent
    return package if (package / EXPERIMENTS).is_file() else package.parents[1] / "results"


def load_experiments(folder: Path) -> dict[str, Experiment]:
    """Experiments by name, in the file's order; raises ResultsError."""
    document: _Experiments = _validated(folder / EXPERIMENTS, _Experiments)
    return document.experiment


def load_tolerances(folder: Path) -> dict[str, Tolerance]:
    """Tolerances by signal; raises ResultsError."""
    document: _Tolerances = _validated(folder / TOLERANCES, _Tolerances)
    return document.tolerance


def chosen(experiments: dict[str, Experiment], names: list[str]) -> dict[str, Experiment]:
    """The named experiments; raises ResultsError for a name that is none of them."""
    for name in names:
        if name not in experiments:
            raise ResultsError(
                f"there is no experiment '{name}'{suggestion(name, experiments)}; "
                f"there are {', '.join(experiments)}"
            )
    return {name: experiments[name] for name in names}


def _validated(path: Path, model: type[Any]) -> Any:
    try:
        return model.model_validate(tomllib.loads(path.read_text("utf-8")))
    except FileNotFoundError:
        raise ResultsError(
            f"'{path}' does not exist; name the folder of the results with --results"
        ) from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise ResultsError(f"'{path}' cannot be read: {error}") from None
    except ValidationError as error:
        raise ResultsError(f"'{path}': {describe(error, model)}") from None
