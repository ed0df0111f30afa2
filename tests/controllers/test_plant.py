"""A plant built from a model: the FMU and the model are one, and wrong input is refused."""

from dataclasses import replace

import casadi as ca
import fmpy
import numpy as np
import pytest

from controllers import Model, Quantity, build_plant
from controllers.errors import ModelError
from tests.helpers.compiler import needs_compiler

LIMITS = {"u": (-10.0, 10.0)}


def lag(**changes):
    """x' = (gain u + d − x) per minute, with a reading that is no state."""
    model = Model(
        name="lag",
        states=(Quantity("x", "m", 1.0),),
        actions=(Quantity("u", "m", 2.0),),
        disturbances=(Quantity("d", "m", 0.5),),
        parameters=(Quantity("gain", "1", 1.5),),
        ode=lambda x, u, d, p: p[0] * u[0] + d[0] - x[0],
        economic_cost=lambda x, u, d, p: ca.exp(-x[0]) + u[0] ** 2,
        outputs={"reading": lambda x, u, d, p: 2.0 * x[0] * p[0]},
        time_unit=60.0,
    )
    return replace(model, **changes)


@needs_compiler
@pytest.mark.slow
@pytest.mark.parametrize("version", [2, 3])
def test_the_fmu_of_a_model_obeys_its_equations(tmp_path, version):
    path = build_plant(
        lag(),
        tmp_path / "lag.fmu",
        sampling_time=30.0,
        limits=LIMITS,
        ranges={"d": 0.25},
        values={"gain": 2.0, "x": 3.0},
        units={"reading": "m"},
        version=version,
    )
    description = fmpy.read_model_description(path)
    units = {variable.name: variable.unit for variable in description.modelVariables}
    assert (units["x"], units["reading"], units["cost"]) == ("m", "m", "1")
    result = fmpy.simulate_fmu(
        str(path), stop_time=300.0, output_interval=30.0, output=["x", "cost", "reading", "d"],
        start_values={"u": 1.0, "stochastic": False}, fmi_type="CoSimulation",
    )  # fmt: skip
    # gain u + d = 2.5 is where it ends; the plant's gain is not the model's.
    exact = 2.5 + 0.5 * np.exp(-result["time"] / 60.0)
    np.testing.assert_allclose(result["x"], exact, rtol=1e-9)
    np.testing.assert_allclose(result["cost"], np.exp(-exact) + 1.0, rtol=1e-9)
    np.testing.assert_allclose(result["reading"], 4.0 * exact, rtol=1e-9)
    noisy = fmpy.simulate_fmu(
        str(path), stop_time=300.0, output_interval=30.0, output=["d"],
        start_values={"seed": 4}, fmi_type="CoSimulation",
    )  # fmt: skip
    assert np.all(np.abs(noisy["d"] - 0.5) <= 0.25)
    assert len(set(noisy["d"])) == 11


@pytest.mark.parametrize(
    ("model", "arguments", "words"),
    [
        (lag(), {"limits": {}}, "limits must have the range of action u"),
        (lag(), {"ranges": {"b": 1.0}}, r"ranges has 'b'.*there are d"),
        (lag(), {"values": {"gian": 1.0}}, r"values has 'gian'.*gain"),
        (lag(), {"values": {"u": 11.0}}, "u is 11 at the start, which is not between"),
        (lag(), {"ranges": {"d": -1.0}}, "ranges of d must be a finite number of at least 0"),
        (lag(), {"values": {"gain": float("nan")}}, "values of gain must be a finite number"),
        (lag(), {"sampling_time": 0.0}, "sampling_time must be positive seconds"),
        (lag(states=(Quantity("a b", "m"),)), {}, "'a b' is no name in C"),
        (lag(name="a lag"), {}, "'a lag' is no name in C"),
        (lag(states=(Quantity("seed", "m"),)), {}, "seed is twice in the FMU"),
        (lag(states=(Quantity("cost", "m"),)), {}, "cost is twice in the FMU"),
    ],
)
def test_what_makes_no_plant_is_refused_in_one_line(tmp_path, model, arguments, words):
    with pytest.raises(ModelError, match=words) as refused:
        build_plant(
            model, tmp_path / "lag.fmu", **({"sampling_time": 30.0, "limits": LIMITS} | arguments)
        )
    assert "\n" not in str(refused.value)
    assert not list(tmp_path.iterdir())
