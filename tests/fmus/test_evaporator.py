from __future__ import annotations

import numpy as np
import pytest

from fmus.evaporator import EVAPORATOR, UNITS, VARIABLES
from fmus.model import Kind, Type

BY_NAME = EVAPORATOR.by_name


@pytest.mark.parametrize("variable", VARIABLES, ids=lambda v: v.name)
def test_ranges_are_given_and_hold_the_start(variable) -> None:
    if variable.kind is Kind.INDEPENDENT or variable.type in (Type.SEED, Type.SEED_HIGH):
        return
    assert variable.min < variable.max
    if variable.settable:
        assert variable.min <= variable.start <= variable.max
    if variable.type is Type.REAL:
        assert variable.nominal is not None
        assert variable.unit in {unit.name for unit in UNITS}


def test_extreme_normal_draws_stay_within_the_declared_range() -> None:
    """The largest |Z| of 53-bit Box and Muller is √(106 ln 2) = 8.58."""
    largest = np.sqrt(106 * np.log(2))
    for name in ("X1", "F1", "T1", "T200"):
        nominal, spread = BY_NAME[f"{name}_nominal"], BY_NAME[f"{name}_range"]
        assert BY_NAME[name].min <= nominal.min - largest * spread.max
        assert BY_NAME[name].max >= nominal.max + largest * spread.max


def test_derived_units_follow_from_their_parts() -> None:
    """kg/kPa, K/kPa and K/% agree with the units that they are made of."""
    units = {unit.name: unit for unit in UNITS}
    for quotient in ("kg/kPa", "K/kPa", "K/%", "kPa/s", "%/s", "kW/K"):
        over, under = (units[part] for part in quotient.split("/"))
        exponents: dict[str, int] = dict(over.exponents)
        for base, exponent in under.exponents:
            exponents[base] = exponents.get(base, 0) - exponent
        exponents = {base: exponent for base, exponent in exponents.items() if exponent}
        assert dict(units[quotient].exponents) == exponents
        assert units[quotient].factor == pytest.approx(over.factor / under.factor)
