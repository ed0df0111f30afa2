"""What the sweep trains: algorithm, samples and hyperparameters of each case, by name.

The hyperparameters of the cases `*-paper` and `*-extended` are the algorithms' defaults, but for
the parametrisation; `q-learning-literal` is the paper's rule as it is printed, and
`q-learning-line-search` that with the line search that the paper names as an option; the cases
`*-mean-cost` have the extended θ and TD errors of the mean cost in place of the discounted one;
`q-learning-warm-up` begins after 1000 samples in place of 200, and `q-learning-cautious` takes
smaller steps besides.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from learning.q_learning import AS_PRINTED

NOISE_SEEDS, STEPS = 50, 1000
"""Held-out noise seeds, and samples on each, of every evaluation."""
TUNING_SEEDS, TUNING_NOISE_SEEDS = 6, 8
"""How many of the first training and noise seeds hyperparameters were chosen on."""


@dataclass(frozen=True)
class Case:
    """One algorithm with its settings, trained with `seeds` seeds 0, 1, …"""

    algorithm: str
    samples: int
    settings: dict[str, Any] = field(default_factory=dict)
    seeds: int = 10


CASES = {
    "actor-critic-paper": Case("actor-critic", 40_000, {"parametrisation": "paper"}),
    "actor-critic-extended": Case("actor-critic", 40_000, {"parametrisation": "extended"}),
    "batch-q-learning-paper": Case("batch-q-learning", 30_000, {"parametrisation": "paper"}),
    "batch-q-learning-extended": Case("batch-q-learning", 30_000, {"parametrisation": "extended"}),
    "q-learning-paper": Case("q-learning", 40_000, {"parametrisation": "paper"}),
    "q-learning-extended": Case("q-learning", 40_000, {"parametrisation": "extended"}),
    "q-learning-literal": Case("q-learning", 100_000, AS_PRINTED, seeds=5),
    "q-learning-line-search": Case(
        "q-learning", 20_000, {**AS_PRINTED, "line_search": True}, seeds=5
    ),
    "q-learning-mean-cost": Case("q-learning", 40_000, {"discount": 1.0}),
    "q-learning-warm-up": Case("q-learning", 40_000, {"warm_up": 1000}),
    "q-learning-cautious": Case("q-learning", 40_000, {"warm_up": 1000, "largest_step": 0.2}),
    "batch-q-learning-mean-cost": Case("batch-q-learning", 30_000, {"discount": 1.0}),
}
