"""Many parallel plants of one scenario, for sampling-hungry learners and vector environments."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cosim.errors import PlantError
from cosim.plant import FmuPlant
from cosim.plant.resource import Resource
from cosim.protocols import Step
from cosim.scenario import Scenario

Array = NDArray[np.float64]


class Steps(NamedTuple):
    """One step of every plant of a pool: the fields of `Step` with a leading axis of plants.

    `s` (count, n), `stage_cost` and `penalty` (count,), `disturbance` (count, p).
    """

    s: Array
    stage_cost: Array
    penalty: Array
    disturbance: Array


class PlantPool(Resource):
    """A fixed number of independent plants over one unpacked FMU, stepped together.

    The instances live in this process: a call costs a few µs, less than handing it to a thread.
    Use one pool per process to fill more cores. A context manager, like `FmuPlant`.

    Raises PlantError as `FmuPlant` does, and if the FMU allows but one instance per process.
    """

    def __init__(
        self, scenario: Scenario | str | Path, count: int, fmu: str | Path | None = None
    ) -> None:
        if count < 1:
            raise PlantError(f"a pool needs at least 1 plant, not {count}")
        self._plants: list[FmuPlant] = []
        self.scenario = scenario if isinstance(scenario, Scenario) else Scenario.load(scenario)
        try:
            for _ in range(count):
                self._plants.append(FmuPlant(self.scenario, fmu))
        except BaseException:
            self.close()
            raise

    def __len__(self) -> int:
        """Return the number of plants."""
        return len(self._plants)

    def __getitem__(self, index: int) -> FmuPlant:
        """Return one of the plants, to step or snapshot it alone."""
        return self._plants[index]

    def __iter__(self) -> Iterator[FmuPlant]:
        """Iterate over the plants."""
        return iter(self._plants)

    def reset(self, seeds: Sequence[int]) -> Array:
        """Reset plant i with seeds[i]; return the states, (count, n)."""
        if len(seeds) != len(self._plants):
            raise PlantError(f"the pool has {len(self._plants)} plants, not {len(seeds)} seeds")
        return np.stack(
            [plant.reset(seed) for plant, seed in zip(self._plants, seeds, strict=True)]
        )

    def step(self, actions: Array) -> Steps:
        """Step plant i under actions[i], (count, m)."""
        if len(actions) != len(self._plants):
            raise PlantError(f"the pool has {len(self._plants)} plants, not {len(actions)} actions")
        steps: list[Step] = [
            plant.step(action) for plant, action in zip(self._plants, actions, strict=True)
        ]
        states, costs, penalties, disturbances = zip(*steps, strict=True)
        return Steps(np.array(states), np.array(costs), np.array(penalties), np.array(disturbances))

    def close(self) -> None:
        """Close every plant."""
        for plant in self._plants:
            plant.close()
