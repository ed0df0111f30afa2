"""`python -m benchmarks.paths N_STATES,HORIZON[,PUMPS] …`: condensed beside stage by stage.

Tanks in series, both paths of the compiled engine on the same states in one process, in turns. It
prints the processor time of each phase and the ratio that `controllers.rti.nmpc` has its rule from.
Two pumps unless it is said: `8,10 16,10 4,40,1`.
"""

import sys

import casadi as ca
import numpy as np

from benchmarks.scaling import PHASES, walk
from controllers import Model, Parameters, Problem, Quantity, RtiNmpc
from controllers.rti.nmpc import Engine

REPETITIONS = 5
SAMPLES = 20


def tanks_in_series(n, horizon, pumps=2):
    """Tanks that empty into each other, each pump into one of them, the first into the first one.

    The cost pulls the last level to its bound.
    """
    fed = [i * n // pumps for i in range(pumps)]
    # At the reference each pump gives a half.
    flows = 0.5 * np.searchsorted(fed, np.arange(n), side="right")

    def ode(x, u, d, p):
        out = flows * ca.sqrt(ca.fmax(x, 1e-3))
        inflow = ca.vertcat(0, out[:-1])
        for i, tank in enumerate(fed):
            inflow[tank] += u[i]
        return inflow - out

    def cost(x, u, d, p):
        return ca.sum1(u) + 0.1 * ca.sumsqr(u) + 0.1 * ca.sumsqr(x - 1)

    model = Model(
        name="tanks_in_series",
        states=tuple(Quantity(f"h{i}", "1") for i in range(n)),
        actions=tuple(Quantity(f"u{i}", "1") for i in range(pumps)),
        disturbances=(),
        parameters=(),
        ode=ode,
        economic_cost=cost,
    )
    state_lower = np.full(n, 0.9)
    state_lower[-1] = 1.0
    return Problem(
        model=model,
        sampling_time=0.5,
        horizon=horizon,
        discount=0.99,
        state_lower=state_lower,
        state_upper=np.full(n, 1.1),
        action_lower=np.zeros(pumps),
        action_upper=np.ones(pumps),
        penalty_linear=np.full(n, 100.0),
        penalty_quadratic=np.full(n, 100.0),
        reference_state=np.ones(n),
        reference_action=np.full(pumps, 0.5),
        reference_cost=1.0,
    )


def controllers_by_path(problem):
    """A compiled controller of each path, and which of them the rule chooses."""
    controllers = {}
    for stagewise in (False, True):
        controller = RtiNmpc(problem, Parameters.naive(problem))
        engine = Engine.compile(controller._functions, stagewise=stagewise)
        assert engine is not None, "there is no C compiler, or it took too long"
        controller._engine = engine
        controllers[stagewise] = controller
    return controllers


def measure(n, horizon, pumps):
    """Print the phases of both paths in µs, and their ratio."""
    case = f"n = {n}, m = {pumps}, N = {horizon}"
    controllers = controllers_by_path(tanks_in_series(n, horizon, pumps))
    best = {path: dict.fromkeys(PHASES, np.inf) for path in controllers}
    for _ in range(REPETITIONS):
        for path, controller in controllers.items():
            for phase, seconds in walk(controller, SAMPLES).items():
                best[path][phase] = min(best[path][phase], seconds)
    sums = {}
    for path, phases in best.items():
        sums[path] = sum(phases.values())
        name = "stage by stage" if path else "condensed"
        parts = ", ".join(f"{phase} {1e6 * phases[phase]:.0f}" for phase in PHASES)
        print(f"{case}, {name}: {1e6 * sums[path]:.0f} µs ({parts})")
    ratio = sums[False] / sums[True]
    print(f"{case}: condensed takes {ratio:.2f} × stage by stage", flush=True)


if __name__ == "__main__":
    for word in sys.argv[1:]:
        numbers = [int(number) for number in word.split(",")]
        measure(*numbers[:2], pumps=numbers[2] if numbers[2:] else 2)
