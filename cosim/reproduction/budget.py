"""How much computing a reproduction gets: same steps, same figures, other sample sizes."""

from __future__ import annotations

from dataclasses import dataclass

FIRST_SEED = 2_000_000
"""First noise seed: neither training (below 10⁶) nor its greedy evaluation (from 10⁶) meets it."""

# The paper's rule as it is printed: unscaled fit with α = 1e-3, its θ, its exploration.
LITERAL = (
    "rule=fit",
    "step_size=1e-3",
    "scaled=false",
    "exploration=scenario",
    "value_offset=stage-cost",
    "parametrisation=paper",
)


@dataclass(frozen=True)
class Learner:
    """A training: its name in the tables, `cosim train` algorithm, samples, hyperparameters."""

    name: str
    algorithm: str
    samples: int
    settings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Budget:
    """Sizes of a reproduction.

    `learners` are each trained with `training_seeds` seeds on the scenario `paper` and evaluated
    on `noise_seeds` × `steps`; the last one is also run as converged NMPC. In the map, `mapper` is
    trained with `map_seeds` seeds and evaluated on `map_noise_seeds` × `map_steps`, at every
    reading of the open points (`factorial`) or at those that differ from `paper` in one point;
    `map_optimum` solves for J* at each.
    """

    learners: tuple[Learner, ...]
    training_seeds: int
    noise_seeds: int
    steps: int
    mapper: Learner
    map_seeds: int
    map_noise_seeds: int
    map_steps: int
    factorial: bool
    map_optimum: bool


BUDGETS = {
    "quick": Budget(
        learners=(
            Learner("q-learning-literal", "q-learning", 20_000, LITERAL),
            Learner("actor-critic", "actor-critic", 20_000),
            Learner("q-learning", "q-learning", 20_000),
        ),
        training_seeds=3,
        noise_seeds=10,
        steps=500,
        mapper=Learner("q-learning", "q-learning", 10_000),
        map_seeds=1,
        map_noise_seeds=8,
        map_steps=500,
        factorial=False,
        map_optimum=False,
    ),
    "full": Budget(
        learners=(
            Learner("q-learning-literal", "q-learning", 100_000, LITERAL),
            Learner("batch-q-learning", "batch-q-learning", 50_000),
            Learner("actor-critic", "actor-critic", 50_000),
            Learner("q-learning", "q-learning", 100_000),
        ),
        training_seeds=10,
        noise_seeds=50,
        steps=1000,
        mapper=Learner("q-learning", "q-learning", 50_000),
        map_seeds=3,
        map_noise_seeds=20,
        map_steps=1000,
        factorial=True,
        map_optimum=True,
    ),
}
