"""The elementary functions against 50 digits of `decimal`."""

import ctypes
import math
from decimal import Decimal, getcontext, localcontext

import numpy as np
import pytest

from fmus.build import SOURCES, local_compiler
from tests.helpers.compiler import needs_compiler

pytestmark = needs_compiler
PI = Decimal("3.14159265358979323846264338327950288419716939937510582097494")
WRAPPER = b"""
#include "elementary.h"
#pragma GCC visibility push(default)
double own_log(double x) { return natural_logarithm(x); }
double own_exp(double x) { return exponential(x); }
double own_cos(double x) { double c, s; cosine_and_sine(x, &c, &s); return c; }
double own_sin(double x) { double c, s; cosine_and_sine(x, &c, &s); return s; }
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    header = (SOURCES / "elementary.h").read_bytes()
    files = {"wrapper.c": WRAPPER, "elementary.h": header}
    path = tmp_path_factory.mktemp("elementary") / "elementary.so"
    path.write_bytes(local_compiler().library(files, "elementary"))
    loaded = ctypes.CDLL(str(path))
    for name in ("own_log", "own_exp", "own_cos", "own_sin"):
        getattr(loaded, name).restype = ctypes.c_double
        getattr(loaded, name).argtypes = [ctypes.c_double]
    return loaded


def ulps(value: float, exact: Decimal) -> float:
    return float(abs(Decimal(value) - exact) / Decimal(math.ulp(float(exact))))


def series(x: Decimal, first: int) -> Decimal:
    """Cos (first 0) or sin (first 1) of x by its Taylor series."""
    term = x if first else Decimal(1)
    total, k = Decimal(0), first
    while abs(term) > Decimal(10) ** -48:
        total += term
        term *= -x * x / ((k + 1) * (k + 2))
        k += 2
    return total


def test_logarithm_is_within_two_ulp(library: ctypes.CDLL) -> None:
    rng = np.random.default_rng(0)
    points = [*rng.uniform(0.0, 1.0, 2000), *np.exp(rng.uniform(-700, 700, 2000)), 2.0**-53, 5e-308]
    points += [1.0 - 2.0**-53, 1.0 + 2.0**-52, math.sqrt(0.5), math.sqrt(2.0), 1.0 - 1e-9]
    with localcontext() as context:
        context.prec = 50
        assert max(ulps(library.own_log(x), Decimal(x).ln()) for x in map(float, points)) < 2.0
    assert library.own_log(1.0) == 0.0


def test_exponential_is_within_two_ulp(library: ctypes.CDLL) -> None:
    rng = np.random.default_rng(1)
    points = [*rng.uniform(-1.0, 1.0, 2000), *rng.uniform(-700, 700, 2000), 1e-300, -700.0, 700.0]
    with localcontext() as context:
        context.prec = 50
        assert max(ulps(library.own_exp(x), Decimal(x).exp()) for x in map(float, points)) < 2.0
    assert library.own_exp(0.0) == library.own_exp(-0.0) == 1.0


def test_cosine_and_sine_of_turns_are_within_1e_16_and_two_ulp(library: ctypes.CDLL) -> None:
    """Two units in the last place of the reduced argument: a result near 0 keeps its digits."""
    rng = np.random.default_rng(2)
    points = [*rng.uniform(0.0, 1.0, 2000), *(0.25 * np.arange(4) + 1e-9), 2.0**-53, 1 - 2.0**-53]
    with localcontext() as context:
        context.prec = 50
        assert getcontext().prec == 50
        for x in map(float, points):
            angle = 2 * PI * Decimal(x)
            assert ulps(library.own_cos(x), series(angle, 0)) < 2.0, x
            assert ulps(library.own_sin(x), series(angle, 1)) < 2.0, x
