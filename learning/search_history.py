"""What a search was given so far, as much of it as brings an equal search to where it is."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from learning.checkpoint import group
from learning.episodes import Block, Learned, Request, Result, Settle, Trial


class SearchHistory:
    """The results that a deterministic plan of episodes was sent, in order.

    What the search no longer looks at is left out, so that its memory does not grow with the
    samples. The predictions of a block give its expected penalty and nothing else: the number takes
    their place. Of the prediction errors two stretches of `memory` count: the latest, and those
    before the round began, which are its pool.
    """

    def __init__(self, memory: int) -> None:
        self._memory = memory
        self._results: list[Result] = []
        self._pool = range(0)
        self._latest, self._errors = 0, 0
        """The first result of the latest stretch, and how many errors that holds."""

    def add(self, request: Request | None, result: Result, expected: float) -> None:
        """Keep the answer to a request; `expected` is the penalty expected of a block in a race."""
        if isinstance(result, Block):
            none = _no_rows(result.predictions.shape[1])
            result = result._replace(predictions=none, expected=expected)
        self._results.append(result)
        if not _remembered(request):
            self._drop_errors(len(self._results) - 1)
        self._errors += len(self._results[-1].errors)
        while self._errors - len(self._results[self._latest].errors) >= self._memory:
            self._errors -= len(self._results[self._latest].errors)
            if self._latest not in self._pool:
                self._drop_errors(self._latest)
            self._latest += 1
        if isinstance(request, Settle):
            for k in range(self._pool.start, min(self._pool.stop, self._latest)):
                self._drop_errors(k)
            self._pool = range(self._latest, len(self._results))

    def _drop_errors(self, k: int) -> None:
        result = self._results[k]
        self._results[k] = result._replace(errors=_no_rows(result.errors.shape[1]))

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything kept, as arrays."""
        state = {"results": np.array(len(self._results))}
        for k, result in enumerate(self._results):
            for name, part in result._asdict().items():
                if part is not None and name != "predictions":
                    state[f"result {k} {name}"] = np.asarray(part)
        return state


def results(state: Mapping[str, NDArray[Any]]) -> Iterator[Result]:
    """The results of a history's `state`."""
    for k in range(int(state["results"])):
        kept = group(state, f"result {k} ")
        if "candidates" in kept:
            yield Learned(**kept)
            continue
        numbers = {name: float(kept[name]) for name in ("stage_cost", "penalty", "expected")}
        yield Block(
            predictions=_no_rows(kept["errors"].shape[1]),
            errors=kept["errors"],
            metric=kept.get("metric"),
            **numbers,
        )


def _remembered(request: Request | None) -> bool:
    """Whether the errors of the answer go into the pools: not those of runs outside races."""
    return not (isinstance(request, Settle) or (isinstance(request, Trial) and request.sensitive))


@cache
def _no_rows(width: int) -> NDArray[np.float64]:
    """No rows, (0, width): one array for all results."""
    return np.zeros((0, width))
