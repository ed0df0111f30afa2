"""How much computing a reproduction gets: same steps, same figures, other sample sizes."""

from __future__ import annotations

from dataclasses import dataclass, replace

FIRST_SEED = 2_000_000
"""First noise seed: neither training (below 10⁶) nor its greedy evaluation (from 10⁶) meets it."""

# The paper's rule as it is printed: unscaled fit with α = 1e-3, its θ, its exploration.
LITERAL = (
    "rule=fit",
    "step_size=1e-3",
    "scaled=false",
    "exploration_probability=0.1",
    "exploration_deviation=[3.1622776601683795]",
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
    on `noise_seeds` × `steps`. The last one is also run as converged NMPC, and mapped: trained
    with the first `map_seeds` of the seeds, and evaluated as above, at every reading of the open
    points and against its J* (`factorial`), or at those readings that differ from `paper` in one
    point, without J*.
    """

    name: str
    learners: tuple[Learner, ...]
    training_seeds: int
    noise_seeds: int
    steps: int
    map_seeds: int
    factorial: bool

    @property
    def mapper(self) -> Learner:
        """The learner of the map."""
        return self.learners[-1]


QUICK = Budget(
    name="quick",
    learners=(
        Learner("q-learning-literal", "q-learning", 20_000, LITERAL),
        Learner("actor-critic", "actor-critic", 20_000),
        Learner("q-learning", "q-learning", 20_000),
    ),
    training_seeds=3,
    noise_seeds=10,
    steps=500,
    map_seeds=1,
    factorial=False,
)

# Twice the samples, and the rule that the quick budget has no time for.
FULL = replace(
    QUICK,
    name="full",
    learners=(
        Learner("batch-q-learning", "batch-q-learning", 40_000),
        *(replace(learner, samples=2 * learner.samples) for learner in QUICK.learners),
    ),
    training_seeds=10,
    noise_seeds=50,
    steps=1000,
    map_seeds=3,
    factorial=True,
)

BUDGETS = {budget.name: budget for budget in (QUICK, FULL)}
