"""The cases of a study, each grid written out."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

from cosim.errors import StudyError
from cosim.study.document import CaseTable, SeedsTable
from cosim.study.protocols import Trainer

BASELINES = "baselines"


@dataclass(frozen=True)
class Case:
    """One point of a grid: a controller, or an algorithm with one set of settings.

    `scenarios` are names; `training_seeds` is empty for a controller. `group` is the panel of the
    figures that shows it.
    """

    name: str
    scenarios: tuple[str, ...]
    group: str
    controller: str | None = None
    algorithm: str | None = None
    samples: int = 0
    start: str = ""
    nmpc: str = ""
    settings: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    training_seeds: tuple[int, ...] = ()

    @property
    def target(self) -> str:
        """The algorithm or the controller."""
        return self.algorithm or self.controller or ""


def expand(
    tables: list[CaseTable],
    scenarios: tuple[str, ...],
    seeds: SeedsTable,
    folder: Path,
    trainer: Trainer,
) -> list[Case]:
    """Write out every grid; files are looked up from `folder`. Raises StudyError."""
    cases = [case for table in tables for case in _cases(table, scenarios, seeds, folder, trainer)]
    seen: dict[str, Case] = {}
    for case in cases:
        if case.name in seen:
            raise StudyError(f"two cases are called '{case.name}'; give each another name")
        seen[case.name] = case
    return cases


def _cases(
    table: CaseTable,
    scenarios: tuple[str, ...],
    seeds: SeedsTable,
    folder: Path,
    trainer: Trainer,
) -> Iterator[Case]:
    chosen = scenarios if table.scenarios is None else tuple(table.scenarios)
    if unknown := [name for name in chosen if name not in scenarios]:
        raise StudyError(
            f"case '{table.name}': '{unknown[0]}' is none of the study's scenarios "
            f"({', '.join(scenarios)})"
        )
    if table.controller is not None:
        sources = table.controller if isinstance(table.controller, list) else [table.controller]
        for source in sources:
            own = Path(source).stem if source.endswith(".toml") else source.replace(":", ".")
            name = own if table.name is None else table.name
            if table.name is not None and len(sources) > 1:
                name = f"{table.name}({own})"
            yield Case(name, chosen, table.group or BASELINES, controller=_file(source, folder))
        return
    assert table.algorithm is not None
    algorithm = table.algorithm
    axes: dict[str, list[Any]] = {}
    for key in ("samples", "start", "nmpc"):
        value = getattr(table, key)
        axes[key] = value if isinstance(value, list) else [value]
    for key, value in table.settings.items():
        axes[key] = _axis(value, trainer.takes_list(algorithm, key))
    if empty := [key for key, values in axes.items() if not values]:
        raise StudyError(f"case '{table.name}': the grid of {empty[0]} is empty")
    varied = [key for key, values in axes.items() if len(values) > 1]
    for values in product(*axes.values()):
        point = dict(zip(axes, values, strict=True))
        label = " ".join(f"{key}={_text(point[key])}" for key in varied)
        yield Case(
            name=f"{table.name}({label})" if label else str(table.name),
            scenarios=chosen,
            group=table.group or algorithm.rpartition(":")[2],
            algorithm=algorithm,
            samples=point.pop("samples"),
            start=_file(point.pop("start"), folder),
            nmpc=point.pop("nmpc"),
            settings=point,
            training=dict(table.training),
            training_seeds=tuple((table.training_seeds or seeds).seeds),
        )


def _axis(value: Any, takes_list: bool) -> list[Any]:
    """Values of a setting: a list is a grid, but for a setting that is a list itself."""
    if not isinstance(value, list):
        return [value]
    nested = bool(value) and all(isinstance(item, list) for item in value)
    return value if nested or not takes_list else [value]


def _file(source: str, folder: Path) -> str:
    """A file's path as seen from the study's folder; every other name as it is."""
    is_file = source.endswith(".toml") and not Path(source).is_absolute()
    return str(folder / source) if is_file else source


def _text(value: Any) -> str:
    return Path(value).stem if isinstance(value, str) else json.dumps(value).replace(" ", "")
