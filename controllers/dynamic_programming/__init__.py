"""Dynamic programming on a grid of states: the optimal policy of a stochastic plant."""

from controllers.dynamic_programming.bellman import (
    Accuracy,
    BellmanOperator,
    Elementwise,
    Refinement,
    accurate_substeps,
    gauss_rule,
)
from controllers.dynamic_programming.grid import Grid, graded_axis
from controllers.dynamic_programming.minimisation import nelder_mead, scan
from controllers.dynamic_programming.solution import (
    SEARCH,
    GainEstimate,
    Optimum,
    RoundProgress,
    Settings,
    certify,
    evaluate_policy,
    objection,
    simulate_policy,
    solve,
)

__all__ = [
    "SEARCH",
    "Accuracy",
    "BellmanOperator",
    "Elementwise",
    "GainEstimate",
    "Grid",
    "Optimum",
    "Refinement",
    "RoundProgress",
    "Settings",
    "accurate_substeps",
    "certify",
    "evaluate_policy",
    "gauss_rule",
    "graded_axis",
    "nelder_mead",
    "objection",
    "scan",
    "simulate_policy",
    "solve",
]
