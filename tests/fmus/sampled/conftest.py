"""A sampled system of a few lines: y = gain·u + the sum of the inputs of earlier samples."""

from collections.abc import Callable, Iterator
from pathlib import Path

import fmpy
import pytest

from fmus import BuildError
from fmus.build import build_model, sampled_table
from fmus.model import FmuModel, Kind, Variable
from tests.helpers.instance import Instance

CORE = b"""
#ifndef CORE_H
#define CORE_H
#include <math.h>
#include <stdint.h>
typedef struct { double sum, seen, y; int64_t status; } CoreState;
static const char *const CORE_MESSAGES[] = {"fine", "the input is negative"};
static void core_reset(CoreState *s) { s->sum = s->seen = s->y = 0.0; s->status = 0; }
static void core_evaluate(CoreState *s, const double u[], int n, const double gain[]) {
    s->status = n == 1 && !(u[0] >= 0.0);
    s->seen = isfinite(u[0]) ? u[0] : 0.0;
    if (s->status == 0) s->y = gain[0] * u[0] + s->sum;
}
static void core_commit(CoreState *s) { s->sum += s->seen; }
static void core_outputs(const CoreState *s, double y[]) { y[0] = s->y; }
static int core_plausible(const CoreState *s) {
    return isfinite(s->sum) && isfinite(s->y) && isfinite(s->seen) && s->status >> 1 == 0;
}
#endif
"""
STEP = 2.0


@pytest.fixture(scope="session")
def adder() -> FmuModel:
    return FmuModel(
        name="adder",
        identifier="adder",
        description="adds its inputs",
        variables=sampled_table(
            [
                Variable("u", Kind.INPUT, unit="kPa", start=1.0, min=-10.0, max=10.0),
                Variable("y", Kind.OUTPUT, unit="kPa"),
                Variable("theta.gain[0]", Kind.TUNABLE, start=1.0),
            ]
        ),
        step_size=STEP,
        sampled=True,
        sources={"core.h": CORE},
    )


@pytest.fixture(scope="session", params=[2, 3], ids=["fmi2", "fmi3"])
def built(request, adder: FmuModel, tmp_path_factory) -> tuple[int, Path]:
    folder = tmp_path_factory.mktemp("sampled")
    try:
        return request.param, build_model(adder, folder / "adder.fmu", request.param)
    except BuildError as error:
        pytest.skip(str(error))


@pytest.fixture
def make(built: tuple[int, Path], tmp_path: Path) -> Iterator[Callable[[], Instance]]:
    """A new instance, not yet initialised; all are freed after the test."""
    version, path = built
    fmpy.extract(str(path), str(tmp_path / "unzipped"))
    made: list[Instance] = []

    def new() -> Instance:
        made.append(Instance(tmp_path / "unzipped", version))
        return made[-1]

    yield new
    for instance in made:
        instance.close()
