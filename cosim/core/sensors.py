"""Sensors: what is measured of a plant at each sample, with noise, seldom and late."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from math import nan

import numpy as np

from cosim.core.errors import PlantError, ScenarioError
from cosim.core.protocols import Array
from cosim.core.scenario import Scenario, SensorTable

DRAWS_AT_ONCE = 256
"""Draws of a sensor that are made at once."""
_SEED = struct.Struct("<Q")
STREAM = 0x53454E53
"""Word of the counter that keeps the sensors' draws apart from every other use of a seed."""


def require_readings(scenario: Scenario, samples: int) -> None:
    """Check that each sensor is read at least once in a run.

    Args:
        scenario: with sensors, or without.
        samples: of the run.

    Raises:
        ScenarioError: the first reading of a sensor comes after the run.
    """
    for table in scenario.sensors or ():
        if table.delay >= samples:
            raise ScenarioError(
                f"scenario '{scenario.name}': the sensor of '{table.variable}' is never read: its "
                f"first reading comes after {table.delay} samples, and the run has {samples}; make "
                "the run longer or the sensor's delay shorter"
            )


class Sensors:
    """The readings of a plant's sensors.

    A sensor takes a reading at the samples 0, `every`, 2·`every`, …: its variable's value then,
    plus normal noise. The reading arrives `delay` samples later; at samples where none arrives
    there is NaN. The noise of sensor i at sample k is a function of (seed, i, k) alone, as the
    FMU's disturbances are. Every controller meets the same.

    Args:
        tables: the sensors, n_y of them.
    """

    def __init__(self, tables: Sequence[SensorTable]) -> None:
        self._tables = tuple(tables)
        self.variables = tuple(table.variable for table in tables)
        self._seed = 0
        # The variables' values at the last samples: sample j is in row j mod memory.
        longest_delay = max(table.delay for table in tables)
        self._memory = longest_delay + 1
        past_shape = (self._memory, len(tables))
        self._past: Array = np.full(past_shape, nan)
        # Of each sensor the block of draws that was used last, with its number.
        self._blocks: dict[int, tuple[int, Array]] = {}

    def start(self, seed: int, values: Sequence[float]) -> Array:
        """Begin an episode.

        Args:
            seed: of the noise, in [0, 2⁶⁴).
            values: of the variables at k = 0, (n_y,).

        Returns:
            y_0, (n_y,).
        """
        self._seed = seed
        self._blocks = {}
        self._past = np.full_like(self._past, nan)
        return self.read(0, values)

    def read(self, k: int, values: Sequence[float]) -> Array:
        """Take the readings of sample k, the one after the last.

        Args:
            k: number of the sample since the start.
            values: of the variables at that sample, (n_y,).

        Returns:
            y_k, (n_y,), what arrives at sample k; NaN where nothing does.
        """
        self._past[k % self._memory] = values
        y = np.full(len(self._tables), nan)
        for i, table in enumerate(self._tables):
            # The sample at which the reading was taken that arrives now.
            taken = k - table.delay
            if taken < 0 or taken % table.every != 0:
                continue
            row = taken % self._memory
            value = self._past[row, i]
            # A sensor without noise draws nothing: no other sensor's draws depend on it.
            if table.deviation > 0.0:
                value += table.deviation * self._noise(i, taken)
            y[i] = value
        return y

    def _noise(self, i: int, k: int) -> float:
        """The standard normal draw of sensor i at sample k."""
        block, index = divmod(k, DRAWS_AT_ONCE)
        kept_block, draws = self._blocks.get(i, (-1, np.empty(0)))
        if kept_block != block:
            draws = self._draw_block(i, block)
            self._blocks[i] = (block, draws)
        return float(draws[index])

    def _draw_block(self, i: int, block: int) -> Array:
        """The standard normal draws of sensor i in a block of samples, (DRAWS_AT_ONCE,)."""
        # As integers of 64 bits: in a list NumPy would round a large seed.
        key = np.array([self._seed, STREAM], dtype=np.uint64)
        # The low words of the counter are those that the draws of a block count up.
        counter = np.array([0, 0, block, i], dtype=np.uint64)
        philox = np.random.Philox(key=key, counter=counter)
        return np.random.Generator(philox).standard_normal(DRAWS_AT_ONCE)

    def state(self) -> tuple[int, Array]:
        """State for `restore`: the seed, and a copy of the last values."""
        return self._seed, self._past.copy()

    def restore(self, state: tuple[int, Array]) -> None:
        """Go back to a `state`."""
        seed, past = state
        # The blocks are draws of one seed.
        if seed != self._seed:
            self._blocks = {}
        self._seed = seed
        self._past = past.copy()

    def to_bytes(self, state: tuple[int, Array]) -> bytes:
        """A `state` as bytes, for any process."""
        seed, past = state
        return _SEED.pack(seed) + past.tobytes()

    def from_bytes(self, data: bytes) -> tuple[tuple[int, Array], bytes]:
        """A `state` from the begin of some bytes, and the rest of these; raises PlantError."""
        begin = _SEED.size
        end = begin + self._past.nbytes
        if len(data) < end:
            raise PlantError("these bytes are not the plant state of a scenario with these sensors")
        (seed,) = _SEED.unpack_from(data)
        numbers = np.frombuffer(data[begin:end])
        # A copy: what lies in bytes cannot be written.
        past = numbers.reshape(self._past.shape).copy()
        state = (seed, past)
        rest = data[end:]
        return state, rest
