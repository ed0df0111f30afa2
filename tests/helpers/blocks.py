"""Blocks of random samples, in place of a loop."""

import numpy as np

from cosim.core.trajectory import SIGNALS


def random_block(scenario, rng, first=0, samples=10):
    columns = {}
    for kind in SIGNALS:
        shape = (samples, len(kind.names(scenario))) if kind.vector else samples
        columns[kind.name] = rng.random(shape) < 0.5 if kind.whole else rng.normal(size=shape)
        columns[kind.name] = columns[kind.name].astype(float)
    columns["time"] = np.arange(first, first + samples) * scenario.sampling_time
    columns["residual"] = np.full(samples, np.nan)
    n, m = len(scenario.plant.states), len(scenario.plant.actions)
    columns["predicted_states"] = rng.normal(size=(samples, 4, n))
    columns["predicted_actions"] = rng.normal(size=(samples, 3, m))
    return first, columns, ["solved"] * samples
