"""The board: entries of others, each a folder of judged runs, checked and shown on one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pandas as pd
from pydantic import Field

from cosim.errors import ResultsError
from cosim.evaluation import judge
from cosim.files import read_toml, write_atomically
from cosim.scenario import Scenario, Table
from cosim.statistics import regret, shown
from cosim.studies.report import rendered
from cosim.validation import validated
from learning.algorithm import Privilege

SEEDS, STEPS = range(3_000_000, 3_000_005), 2000
"""Noise of the entries, which no study and no training may meet; samples, unless it says."""
MOST_FILES, MOST_BYTES = 20, 2_000_000
"""Of an entry: runs of all seeds take half of it."""
Text = Annotated[str, Field(pattern=r"^[^|<>\[\]\\`\r\n]+$", max_length=100)]


class Entry(Table):
    """entry.toml of a board's entry: author, method, and plant access."""

    name: Text
    authors: Text
    link: Annotated[str, Field(pattern=r"^(https?://[^\s|<>()]+)?$", max_length=200)] = ""
    scenario: Annotated[str, Field(pattern=r"^[\w-]+$")]
    asks_for: Literal["nothing"] | Privilege
    samples: Annotated[int, Field(ge=0)]
    steps: Annotated[int, Field(ge=100, le=20_000)] = STEPS

    @property
    def task(self) -> str:
        """The table that the entry is in: one a scenario and length."""
        return f"`{self.scenario}`" + f", {self.steps} samples" * (self.steps != STEPS)


def read_entry(folder: Path) -> tuple[Entry, pd.DataFrame]:
    """A board's entry and its judged runs, those in `runs` played back; raises CosimError."""
    sizes = [each.stat().st_size for each in folder.rglob("*") if each.is_file()]
    if len(sizes) > MOST_FILES or sum(sizes) > MOST_BYTES:
        raise ResultsError(f"'{folder}' has over {MOST_FILES} files or {MOST_BYTES} bytes")
    path, origin = folder / "entry.toml", f"'{folder / 'entry.toml'}'"
    entry = validated(Entry, read_toml(path, origin, ResultsError), origin, ResultsError)
    scenario = Scenario.load(entry.scenario)
    asked = [(seed, entry.steps, scenario.hash) for seed in SEEDS]
    try:
        rows = pd.read_csv(folder / "judged.csv", dtype={"scenario_hash": str})
        found = list(rows[["seed", "steps", "scenario_hash"]].itertuples(False, None))
        if found != asked or not np.isfinite(rows["J"]).all():
            raise ValueError(f"judged.csv must have J and seed, steps, scenario_hash = {asked}")
        again = judge(scenario, folder / "runs").set_index("seed")[["J", "optimum"]]
        said = rows.set_index("seed").loc[again.index, ["J", "optimum"]]
        if again.index[0] != SEEDS[0] or not np.allclose(again, said, 1e-6, equal_nan=True):
            raise ValueError("runs/ must hold the run of the first seed, and give judged.csv's row")
        if (entry.asks_for == "nothing") != (not entry.samples):
            raise ValueError("samples must be 0 where asks_for is 'nothing', and only there")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ResultsError(f"'{folder}': {error}") from None
    return entry, rows


def write_board(folder: Path) -> list[str]:
    """Check the entries of a board and write its README.md; returns their folders' names."""
    paths = sorted(path.parent for path in folder.glob("*/entry.toml"))
    entries = sorted(map(read_entry, paths), key=lambda one: float(one[1]["J"].mean()))
    page = rendered("board.md", entries=entries, regret=regret, shown=shown)
    write_atomically(folder / "README.md", page)
    return [path.name for path in paths]
