"""The stored reference signals: reproduced bit for bit, and right by an independent integration."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import fmus
from benchmarks.importers import relative_difference
from tests.helpers import crosscheck
from tests.helpers.paper import evaporator


@pytest.mark.parametrize("name", fmus.NAMES)
def test_stored_signals_are_reproduced_bit_for_bit(name: str) -> None:
    crosscheck.hold(fmus.path(name))


@pytest.mark.parametrize("case", crosscheck.CASES)
def test_model_exchange_agrees_to_1e_6(version: int, case: str) -> None:
    path = fmus.path(fmus.NAMES[version - 2])
    result = crosscheck.simulate(path, case, "ModelExchange", relative_tolerance=1e-10)
    expected = crosscheck.load(case)
    # where an input jumps, fmpy records co-simulation before, and model exchange after the jump
    expected = expected[expected["time"] % crosscheck.HOLD != 0.0]
    last = np.searchsorted(result["time"], expected["time"] + 1e-3) - 1
    columns = [
        np.stack([rows[n] for n in crosscheck.OUTPUTS], axis=1) for rows in (result[last], expected)
    ]
    assert relative_difference(*columns) < 1e-6


def test_stored_states_solve_the_differential_equations() -> None:
    for case in crosscheck.CASES:
        stored = crosscheck.load(case)
        for k in range(len(stored) - 1):
            hold = int(stored["time"][k] // crosscheck.HOLD)
            p100, f200 = crosscheck.P100[hold], crosscheck.F200[hold]
            x1, f1, t1, t200 = (stored[n][k] for n in ("X1", "F1", "T1", "T200"))

            # 0.03 days are 43.2 samples
            tau = (k - 43.2 * (k // 43.2)) / 1440 if case == "drifting" else 0.0
            ua2 = 6.84 * (0.6 + 0.4 * np.exp(-20.0 * tau))

            def rates(_, y, u=(p100, f200), d=(x1, f1, t1, t200), ua2=ua2):
                return evaporator(y, u, d, UA2=ua2)["rates"]

            start = stored["X2"][k], stored["P2"][k]
            end = solve_ivp(rates, (0, 1), start, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
            np.testing.assert_allclose(end, (stored["X2"][k + 1], stored["P2"][k + 1]), rtol=1e-9)
