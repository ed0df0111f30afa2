"""Build what depends on a problem and θ's blocks alone once for all that have the same content."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache, wraps
from typing import Concatenate, ParamSpec, TypeVar

from controllers.problem import Problem

P = ParamSpec("P")
Built = TypeVar("Built")

KEPT = 32
"""Results that a function keeps: those of the problems that were used last."""


@dataclass(frozen=True)
class _Call:
    """A call of the function: equal to another one where content and arguments are equal."""

    content: str
    arguments: tuple[object, ...]
    options: tuple[tuple[str, object], ...]
    problem: Problem = field(compare=False)


def built_once(
    build: Callable[Concatenate[Problem, P], Built],
) -> Callable[Concatenate[Problem, P], Built]:
    """Keep what a function of a problem builds, for problems of the same `Problem.content`.

    A training, an evaluation and a study make many controllers of one problem, and CasADi's graphs
    take most of the time to make one. What is kept is shared, so it must never change.

    Args:
        build: Function of a problem and of other hashable arguments. Its result depends on nothing
            else.
    """

    @lru_cache(maxsize=KEPT)
    def kept(call: _Call) -> Built:
        options = dict(call.options)
        return build(call.problem, *call.arguments, **options)  # type: ignore[arg-type]

    @wraps(build)
    def find(
        problem: Problem,
        /,
        *arguments: P.args,
        **options: P.kwargs,
    ) -> Built:
        # A dictionary has no hash, which the cache looks a call up by.
        hashable_options = tuple(options.items())
        call = _Call(problem.content, arguments, hashable_options, problem)
        return kept(call)

    return find
