"""Algorithms that follow a plan: a generator of episodes, which reads what each one told.

A checkpoint keeps what they told; restoring lets the deterministic plan read it once more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from cosim.protocols import Matrix, Vector
from learning.algorithm import Algorithm, Transition, Update
from learning.checkpoint import State, arrays_of, take_up
from learning.step import moved

Told = dict[str, Any]


def numbers(transition: Transition) -> list[float]:
    """(s, a, s₊) of a transition; so a row takes half of the time that NumPy's functions do."""
    s, a, following = transition.s, transition.a, transition.next_s
    return [*s.tolist(), *a.tolist(), *following.tolist()]


@dataclass(eq=False)
class Episode:
    """The next `length` samples at θ (n_θ,), whose `answer` the plan reads when it goes on.

    On a simulator the plant is reset before them, where `seed` gives its noise, or put back to
    where it was marked (`rewind`), noise included, and marked after them (`mark`). The plan says of
    an answer that it has `refused` to go where that led.

    Kept are `costs`, the samples' shares of J, and of samples at which the controller did not fail
    `rows` (number, ℓ, p(s₊), s, a, s₊) and what `measure` makes of transition and number.
    """

    KEPT: ClassVar[tuple[str, ...]] = ("length", "costs", "rows", "measured")
    theta: Vector
    length: int
    seed: int | None = None
    rewind: bool = False
    mark: bool = False
    measure: Callable[[Transition, int], Matrix | None] | None = None
    costs: list[float] = field(default_factory=list, init=False)
    rows: list[list[float]] = field(default_factory=list, init=False)
    measured: list[Any] = field(default_factory=list, init=False)
    answer: Told = field(default_factory=dict, init=False)
    refused: bool = field(default=False, init=False)

    def take(self, transition: Transition | None, cost: float) -> bool:
        """Take a sample, None where the controller failed, and its share of J: was it the last?"""
        if transition is not None:
            number = len(self.costs)
            costs = number, transition.stage_cost, transition.next_penalty
            self.rows.append([*costs, *numbers(transition)])
            if self.measure and (measured := self.measure(transition, number)) is not None:
                self.measured.append(measured.tolist())
        self.costs.append(cost)
        return len(self.costs) >= self.length

    def samples(self, columns: int) -> Matrix:
        """The rows as an array, (K, 3+2n+m)."""
        return np.array(self.rows).reshape(-1, columns)


class Planned(Algorithm):
    """An algorithm that takes the episodes of a plan until it ends; its constructor `follow`s one.

    `theta` is what the run would hand over; the controller carries the θ of the episode.
    """

    theta: Any
    _episode: Any

    def follow(self, plan: Iterator[Any]) -> None:
        """Begin a plan."""
        self._plan, self._history = plan, list[Told]()
        self._begin(next(plan, None))
        self.first_episode = self._seed

    def _begin(self, episode: Any) -> None:
        """Set θ for an episode; with None the plan has ended."""
        self._episode = episode
        self.controller.theta = self.theta if episode is None else episode.theta

    def _tell(self, told: Told) -> None:
        """Answer the plan, and begin its next episode."""
        self._history.append(told)
        self._episode.answer = told
        self._begin(next(self._plan, None))

    def told(self) -> Told:
        """What the episode told, when all its samples are taken."""
        raise NotImplementedError

    @property
    def _seed(self) -> int | None:
        """Seed of the episode's noise, which only a simulator can choose."""
        simulates = self._episode is not None and self.asks_for == "simulator"
        return self._episode.seed if simulates else None

    def observe(self, transition: Transition | None, cost: float = 0.0) -> Update | None:
        """Take one sample; the last one of an episode begins the next."""
        taken, cost = self._episode, cost if transition is None else transition.cost
        if taken is None or not taken.take(transition, cost):
            return None
        old = self.controller.theta
        self._tell(self.told())
        parameters, begun = self.controller.parameters, self._episode
        return moved(
            parameters.blocks,
            old,
            parameters.theta,
            refused=taken.refused,
            episode=self._seed,
            mark=taken.mark,
            rewind=begun is not None and begun.rewind,
        )

    def failed(self, cost: float) -> Update | None:
        """Take a sample at which the controller failed, with its share of J."""
        return self.observe(None, cost)

    def state(self) -> State:
        """What the plan was told, the open episode, and `KEPT`."""
        state = super().state() | {"told": self._history}
        return state | {"episode": None if self._episode is None else arrays_of(self._episode)}

    def restore(self, state: State) -> None:
        """Restore what `state` returned."""
        theta = self.controller.theta
        for told in state["told"]:
            self._tell(told)
        self.controller.theta = theta
        if self._episode is not None:
            take_up(self._episode, state["episode"])
        super().restore(state)
