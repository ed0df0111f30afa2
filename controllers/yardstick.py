"""What regret is measured against: the optimum of a scenario's plant, or what stands in for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from controllers.dynamic_programming.plant import StochasticScenario
from controllers.dynamic_programming.solution import Progress
from controllers.optimum import OptimalPolicy
from controllers.quasi_static import Fouling, QuasiStaticPolicy


@dataclass(frozen=True)
class Yardstick:
    """What regret is measured against: `value`, a mean cost per sample, and its `kind`.

    The kind `optimum` is J*; `reference` is a figure that a better controller may beat, and `note`
    says why. `controller` is the one of that cost.
    """

    value: float
    kind: Literal["optimum", "reference"]
    controller: OptimalPolicy | QuasiStaticPolicy
    note: str = ""


def optimal(
    scenario: StochasticScenario, progress: Callable[[Progress], None] | None = None
) -> OptimalPolicy | QuasiStaticPolicy:
    """The optimal policy of a scenario, or the quasi-static one of a condenser that fouls."""
    if Fouling.of(scenario) is None:
        return OptimalPolicy.from_scenario(scenario, progress=progress)
    return QuasiStaticPolicy.from_scenario(scenario, progress=progress)


def yardstick(scenario: StochasticScenario) -> Yardstick | None:
    """What is stored for a scenario, None where nothing is; solves nothing."""
    if Fouling.of(scenario) is not None:
        found = QuasiStaticPolicy.stored(scenario)
        note = "quasi-static: J* along UA2(t), no bound"
        return None if found is None else Yardstick(found.gain, "reference", found, note)
    policy = OptimalPolicy.stored(scenario)
    if policy is None:
        return None
    certificate = policy.optimum.certificate
    objection = "not certified" if certificate is None else certificate.objection()
    if objection is None:
        return Yardstick(policy.gain, "optimum", policy)
    return Yardstick(policy.gain, "reference", policy, objection)
