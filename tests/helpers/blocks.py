"""Blocks of random samples, in place of a loop."""

import numpy as np

from cosim.protocols import Block


def random_block(scenario, rng, first=0, samples=10, predicts=True, status="solved"):
    n, m = len(scenario.plant.states), len(scenario.plant.actions)
    p = len(scenario.plant.disturbances)
    return Block(
        first=first,
        time=np.arange(first, first + samples) * scenario.sampling_time,
        states=rng.normal(size=(samples, n)),
        actions=rng.normal(size=(samples, m)),
        disturbances=rng.normal(size=(samples, p)),
        stage_cost=rng.normal(size=samples),
        penalty=rng.normal(size=samples),
        value=rng.normal(size=samples),
        residual=np.full(samples, np.nan),
        explored=rng.random(samples) < 0.5,
        failed=rng.random(samples) < 0.5,
        status=[status] * samples,
        prepare_time=rng.random(samples),
        feedback_time=rng.random(samples),
        predicted_states=rng.normal(size=(samples, 4, n)) if predicts else None,
        predicted_actions=rng.normal(size=(samples, 3, m)) if predicts else None,
    )
