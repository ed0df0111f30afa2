"""Judges closed loops that another tool ran: their actions, played back on the seeds' noise."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from cosim.errors import EvaluationError
from cosim.plant import FmuPlant
from cosim.plugins import build_controller
from cosim.protocols import Array, Decision
from cosim.scenario import Scenario
from cosim.simulation import indicators, measure, simulate
from learning.training import stored_optimum

TOLERANCE = 1e-6
"""Largest difference of a state from the one played back, relative to 1 + its magnitude."""


class _Recorded:
    """Plays recorded actions back and holds the recorded states to the plant's."""

    name = "recorded"

    def __init__(self, path: Path, states: pd.DataFrame, actions: Array) -> None:
        self._path, self._states, self._actions = path, states, actions
        self._k = -1

    def reset(self) -> None:
        """Begin with the first sample."""
        self._k = -1

    def prepare(self) -> None:
        """Go on to the next sample."""
        self._k += 1

    def feedback(self, s: Array, a: object = None) -> Decision:
        """The sample's action; EvaluationError where its state is not that of the seed's noise."""
        for (name, column), expected in zip(self._states.items(), s.tolist(), strict=True):
            found = float(column.iloc[self._k])
            if not abs(found - expected) <= TOLERANCE * (1 + abs(expected)):
                raise EvaluationError(
                    f"'{self._path}': {name} at sample {self._k} is {found!r}; the seed's noise "
                    f"under these actions gives {expected!r} (cosim scenario NAME --seed-values K "
                    "prints the plant's start values)"
                )
        return Decision(self._actions[self._k])


def judge(scenario: Scenario, folder: Path) -> pd.DataFrame:
    """A row of indicators for each ``*.csv`` of a folder, whose name ends in the run's seed.

    A file has a column for each state and action of the scenario by name (a unit in brackets may
    follow) and a row a sample: the state, and the action that was then applied. The actions are
    played back on the seed's noise, and what the file says of the states is checked against it:
    the figures are those of the playback. Columns `file`, `seed`, `steps`, `indicators`', and
    `optimum` and `regret`, J of the stored optimum on the same noise, NaN where there is none.
    Raises EvaluationError with file, sample and both values.
    """
    paths = sorted(folder.glob("*.csv"))
    if not paths:
        raise EvaluationError(f"'{folder}' holds no .csv file")
    best, rows = stored_optimum(scenario), []
    optimum = None if best is None else build_controller(best, scenario)
    with FmuPlant(scenario) as plant:
        for path in paths:
            seed, recorded, steps = _read(path, scenario)
            row: dict[str, Any] = {"file": path.name, "seed": seed, "steps": steps}
            row |= indicators(simulate(plant, recorded, steps, seed, residuals=False))
            cost = np.nan if optimum is None else measure(plant, optimum, seed, steps)[0]["J"]
            rows.append(row | {"optimum": cost, "regret": row["J"] / cost - 1})
    return pd.DataFrame(rows).sort_values("seed", ignore_index=True)


def _read(path: Path, scenario: Scenario) -> tuple[int, _Recorded, int]:
    number = re.search(r"(\d+)$", path.stem)
    if number is None:
        raise EvaluationError(f"'{path}': a file's name ends in its seed, as run-7.csv")
    try:
        table = pd.read_csv(path)
        table = table.rename(columns=lambda title: title.partition(" [")[0].strip())
        plant = scenario.plant
        numbers = table[[*plant.states, *plant.actions]].astype(float)
    except (OSError, ValueError, KeyError) as error:
        raise EvaluationError(f"'{path}' is no trajectory: {error}") from None
    actions = numbers[list(plant.actions)].to_numpy()
    inside = (actions >= scenario.action_lower) & (actions <= scenario.action_upper)
    if not len(actions) or not inside.all():
        k = 0 if not len(actions) else int(np.argmin(inside.all(axis=1)))
        raise EvaluationError(f"'{path}': the action at sample {k} is missing or beyond its bounds")
    return int(number[1]), _Recorded(path, numbers[list(plant.states)], actions), len(actions)
