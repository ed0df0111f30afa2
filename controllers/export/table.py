"""The variables of an exported controller: what its inputs, outputs and parameters mean."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from controllers.export.core import STATUSES, Core


class Entry(NamedTuple):
    """A variable by `name`, with its `unit` and `meaning` in words.

    `start` is that of an input or parameter; `lower` or `upper` is None where there is no bound.
    """

    name: str
    unit: str
    meaning: str
    start: float | None = None
    lower: float | None = None
    upper: float | None = None


class Table(NamedTuple):
    """Variables in the order of the arrays that the C takes: `inputs`, `outputs`, `parameters`."""

    inputs: tuple[Entry, ...]
    outputs: tuple[Entry, ...]
    parameters: tuple[Entry, ...]


def table(
    core: Core, states: Sequence[tuple[str, str]], actions: Sequence[tuple[str, str]]
) -> Table:
    """Variables of a controller whose states and actions have these names and units."""
    problem, blocks = core.problem, core.parameters.blocks
    stages = range(problem.horizon + 1)
    meanings = [block.meaning for block in blocks for _ in range(block.size)]
    bounds = zip(problem.action_lower, problem.action_upper, strict=True)
    codes = ", ".join(f"{code} {text}" for code, text in enumerate(STATUSES))
    return Table(
        inputs=tuple(
            Entry(name, unit, "measured state", float(start))
            for (name, unit), start in zip(states, problem.reference_state, strict=True)
        ),
        outputs=(
            *(
                Entry(name, unit, "action, within its bounds", None, float(low), float(high))
                for (name, unit), (low, high) in zip(actions, bounds, strict=True)
            ),
            Entry("value", "", "value V(s) of the state"),
            Entry("qp_status", "", f"of the present sample: {codes}"),
            Entry("kkt_residual", "", "largest KKT residual of the last QP that was solved"),
            Entry("qp_iterations", "", "steps of the QP solver in the last QP that was solved"),
            Entry("failures", "", "samples without a solution so far; they repeat the last action"),
            *(
                Entry(f"predicted.{name}[{k}]", unit, f"predicted {name}, {k} samples ahead")
                for k in stages
                for name, unit in states
            ),
            *(
                Entry(f"predicted.{name}[{k}]", unit, f"predicted {name}, {k} samples ahead")
                for k in stages[:-1]
                for name, unit in actions
            ),
        ),
        parameters=tuple(
            Entry(f"theta.{_structured(label)}", "", meaning, float(value))
            for label, meaning, value in zip(
                blocks.labels, meanings, core.parameters.theta, strict=True
            )
        ),
    )


def _structured(label: str) -> str:
    """A label of θ as FMI's structured names have it: `p[UA2]` becomes `p.UA2`."""
    block, bracket, rest = label.partition("[")
    inner = rest.removesuffix("]")
    return label if not bracket or inner.replace(",", "").isdigit() else f"{block}.{inner}"
