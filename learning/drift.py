"""What changes in a plant that drifts, for the log: the learner is not told."""

from __future__ import annotations

from controllers.optimum import DAY, Fouling, QuasiStaticPolicy
from cosim.scenario import Scenario


class Drift:
    """The parameter that fouls and the quasi-static reference at a time.

    `of` gives none for another plant, whose log has no such columns.
    """

    def __init__(self, fouling: Fouling, reference: QuasiStaticPolicy | None) -> None:
        self._fouling, self._reference = fouling, reference

    @classmethod
    def of(cls, scenario: Scenario) -> Drift | None:
        """What drifts in a scenario's plant, None where nothing does."""
        fouling = Fouling.of(scenario)
        return None if fouling is None else cls(fouling, QuasiStaticPolicy.stored(scenario))

    def row(self, time: float) -> dict[str, float]:
        """The parameter and J* at it, by column, at a time in s; J* is NaN where none is stored."""
        days = time / DAY
        present = float(self._fouling.heat_transfer(days))
        reference = (
            float("nan") if self._reference is None else float(self._reference.gain_at(present))
        )
        return {self._fouling.parameter: present, "reference_J": reference}
