"""Model exchange: time events, states and derivatives."""

import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from scipy.integrate import solve_ivp


def advance(model, begin: float, end: float) -> None:
    """Integrate tightly over one interval without events, then leave the model at its end."""

    def rates(time: float, x: np.ndarray) -> list[float]:
        model.fmu.setTime(time)
        model.set_states(list(x))
        return model.derivatives()

    solution = solve_ivp(
        rates, (begin, end), model.get("X2", "P2"), method="DOP853", rtol=1e-11, atol=1e-11
    )
    model.fmu.setTime(end)
    model.set_states(list(solution.y[:, -1]))
    model.fmu.completedIntegratorStep()


@pytest.mark.parametrize("law", [1, 2])
def test_tight_integration_with_events_agrees_with_co_simulation(open_fmu, version, law) -> None:
    plant = open_fmu(version).initialise(seed=8, law=law)
    model = open_fmu(version, exchange=True).initialise(seed=8, law=law)
    for k in range(10):
        assert model.start_continuous_time() == 60.0 * (k + 1)
        assert model.get("X1", "F1", "T1", "T200") == plant.get("X1", "F1", "T1", "T200")
        advance(model, 60.0 * k, 60.0 * (k + 1))
        model.fmu.enterEventMode()
        plant.step(60.0 * k, 60.0)
        np.testing.assert_allclose(model.get("X2", "P2"), plant.get("X2", "P2"), rtol=1e-9)


def test_disturbance_is_held_until_the_event_is_handled(model) -> None:
    model.initialise(seed=8)
    model.start_continuous_time()
    before = model.get("X1")
    model.fmu.setTime(60.0)
    assert model.get("X1") == before
    model.fmu.enterEventMode()
    assert model.get("X1") == before
    model.start_continuous_time()
    assert model.get("X1") != before


@pytest.mark.parametrize("switch", [{"stochastic": False}, {"override": True}])
def test_no_event_when_nothing_is_drawn(model, switch: dict[str, bool]) -> None:
    assert model.initialise(**switch).start_continuous_time() is None


def test_override_switched_off_at_an_event_draws_the_current_sample(open_fmu, version) -> None:
    model = open_fmu(version, exchange=True).initialise(seed=8, override=True)
    model.start_continuous_time()
    model.fmu.setTime(130.0)
    model.fmu.enterEventMode()
    model.set(override=False)
    assert model.start_continuous_time() == 180.0
    expected = open_fmu(version).initialise(start=130.0, seed=8).get("X1")
    assert model.get("X1") == expected


def test_trial_times_past_the_stop_time_pass_but_steps_do_not(model) -> None:
    model.initialise(stop=100.0)
    model.start_continuous_time()
    model.fmu.setTime(101.0)
    with pytest.raises(FMICallException):
        model.fmu.completedIntegratorStep()
    assert "past the stop time" in model.messages[-1][2]
    model.fmu.setTime(100.0)
    assert tuple(bool(flag) for flag in model.fmu.completedIntegratorStep()) == (False, False)
