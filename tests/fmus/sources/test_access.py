"""Access to variables: what is refused, with which status and message, and that nothing changes."""

import math

import pytest

from fmus.evaporator import EVAPORATOR, VARIABLES
from fmus.model import Kind, Type

DISCARD, ERROR = 2, 3
REAL_SETTABLE = [v.name for v in VARIABLES if v.settable and v.type is Type.REAL]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["P100", "X1_in", "a", "X2_start"])
def test_non_finite_value_is_an_error(refused, plant, name: str, value: float) -> None:
    before = plant.initialise().get(name) if name != "X2_start" else None
    status, text = refused(plant, lambda: plant.set(**{name: value}))
    assert status == ERROR
    assert f"the value of {name} is not finite" in text
    assert before is None or plant.get(name) == before


@pytest.mark.parametrize(
    ("name", "value"), [("P100", 99.9), ("P100", 400.1), ("F200", 0.0), ("F200", 1e9)]
)
def test_input_out_of_range_is_discarded(refused, plant, name: str, value: float) -> None:
    plant.initialise()
    before = plant.run(0)
    status, text = refused(plant, lambda: plant.set(**{name: value}))
    assert status == DISCARD
    assert f"{name} = " in text
    assert "outside [100, 400]" in text
    assert plant.run(0) == before


@pytest.mark.parametrize(
    ("value", "acting"), [(0.0, 100.0), (99.9, 100.0), (400.1, 400.0), (1e9, 400.0), (250.0, 250.0)]
)
def test_a_saturating_input_acts_at_its_bound(open_fmu, version: int, value, acting) -> None:
    saturating, plain = open_fmu(version), open_fmu(version)
    saturating.initialise(saturate=True).set(P100=value)
    plain.initialise().set(P100=acting)
    assert saturating.get("P100") == [acting]
    assert saturating.run(2) == plain.run(2)


@pytest.mark.parametrize("name", REAL_SETTABLE)
def test_range_of_the_model_description_is_enforced(refused, plant, name: str) -> None:
    variable = EVAPORATOR.by_name[name]
    plant.set(**{name: variable.min})
    plant.set(**{name: variable.max})
    for value in (math.nextafter(variable.min, -math.inf), math.nextafter(variable.max, math.inf)):
        assert refused(plant, lambda v=value: plant.set(**{name: v}))[0] == DISCARD


@pytest.mark.parametrize("kind", [Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT])
def test_calculated_variable_cannot_be_set(refused, plant, kind: Kind) -> None:
    plant.initialise()
    for variable in (v for v in VARIABLES if v.kind is kind):
        suffix = "Real" if plant.version == 2 else "Float64"
        setter = getattr(plant.fmu, f"set{suffix}")
        reference = EVAPORATOR.value_reference(variable.name)
        status, text = refused(plant, lambda s=setter, r=reference: s([r], [1.0]))
        assert status == ERROR
        assert f"{variable.name} cannot be set" in text


def test_fixed_parameter_cannot_be_set_after_initialisation(refused, plant) -> None:
    plant.initialise()
    values = {"X2_start": 26.0, "sampling_time": 6.0, "seed": 1, "law": 2, "saturate": True}
    for name, value in values.items():
        status, text = refused(plant, lambda n=name, v=value: plant.set(**{n: v}))
        assert status == ERROR
        assert "step mode" in text


def test_refused_call_with_several_values_changes_none_of_them(refused, plant) -> None:
    plant.initialise()
    before = plant.get("P100", "F200")
    suffix = "Real" if plant.version == 2 else "Float64"
    references = [EVAPORATOR.value_reference("P100"), EVAPORATOR.value_reference("F200")]
    setter = getattr(plant.fmu, f"set{suffix}")
    assert refused(plant, lambda: setter(references, [300.0, math.nan]))[0] == ERROR
    assert plant.get("P100", "F200") == before


def test_instance_goes_on_after_a_refused_call(refused, open_fmu, version: int) -> None:
    disturbed, clean = open_fmu(version).initialise(), open_fmu(version).initialise()
    for k in range(3):
        refused(disturbed, lambda: disturbed.set(P100=math.nan))
        refused(disturbed, lambda k=k: disturbed.step(60.0 * k, math.nan))
        disturbed.step(60.0 * k, 60.0)
        clean.step(60.0 * k, 60.0)
    assert disturbed.run(0) == clean.run(0)
