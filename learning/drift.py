"""What changes in a plant that drifts or jumps, for the log: the learner is not told."""

from __future__ import annotations

from controllers.optimum import Fouling, Jumps, QuasiStaticPolicy, change_of
from cosim.scenario import Scenario


class Drift:
    """The parameters that change and the quasi-static reference at a time.

    `of` gives none for another plant, whose log has no such columns.
    """

    def __init__(self, law: Fouling | Jumps, reference: QuasiStaticPolicy | None) -> None:
        self._law, self._reference = law, reference

    @classmethod
    def of(cls, scenario: Scenario) -> Drift | None:
        """What changes in a scenario's plant, None where nothing does."""
        law = change_of(scenario)
        return None if law is None else cls(law, QuasiStaticPolicy.stored(scenario))

    def row(self, time: float) -> dict[str, float]:
        """The parameters and J* at a time in s, by column; J* is NaN where none is stored."""
        known = self._reference
        reference = float("nan") if known is None else float(known.gain_at(time))
        return self._law.present(time) | {"reference_J": reference}
