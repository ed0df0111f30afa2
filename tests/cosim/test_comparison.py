import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cosim import FmuPlant, simulate
from cosim.comparison import RunSignals, compare, load_run
from cosim.core.errors import ComparisonError
from cosim.core.trajectory import Signal
from cosim.recording import RerunRecorder
from tests.helpers.loop import Proportional

values = st.one_of(st.floats(-1e3, 1e3), st.just(float("nan")), st.just(float("inf")))


def run(status=(), **signals):
    table = {name: Signal(name, "kPa", np.array(v, dtype=float)) for name, v in signals.items()}
    return RunSignals("run", table, status)


@given(st.lists(st.tuples(values, values), min_size=1, max_size=30), st.floats(0.0, 10.0))
def test_first_and_largest_difference_against_a_plain_loop(pairs, tolerance):
    a, b = zip(*pairs, strict=True)
    found = compare(run(x=a), run(x=b), {"x": tolerance}).differences[0]

    def distance(x, y):
        if x == y or (np.isnan(x) and np.isnan(y)):
            return 0.0
        return np.inf if np.isnan(x) or np.isnan(y) else abs(x - y)

    distances = [distance(x, y) for x, y in pairs]
    assert found.maximum == max(distances)
    assert distances[found.at] == max(distances)
    beyond = [k for k, value in enumerate(distances) if value > tolerance]
    assert found.first == (beyond[0] if beyond else None)


def test_the_relative_tolerance_goes_with_the_largest_magnitude():
    a, b = run(P2=[-200.0, 1.0], c=[1.0, 1.0]), run(P2=[-200.0, 2.0], c=[1.0, 1.1])
    result = compare(a, b, relative=0.01)
    assert [d.tolerance for d in result.differences] == [2.0, 0.01]
    assert [d.first for d in result.differences] == [None, 1]


def test_the_residual_is_left_out_of_the_relative_tolerance_alone():
    a, b = run(P2=[50.0], residual=[1e-16]), run(P2=[50.1], residual=[1e-12])
    assert compare(a, b, relative=0.01).equal
    assert compare(a, b, {"P2": 1.0}).lines() == compare(a, b, {"P2": 1.0}, relative=0.0).lines()
    assert compare(a, b, {"P2": 1.0}).first == 0
    assert compare(a, b, {"residual": 1e-13}, relative=0.01).first == 0


@pytest.mark.parametrize("tolerance", [-1.0, float("nan")])
def test_a_tolerance_that_is_none_is_refused(tolerance):
    with pytest.raises(ComparisonError):
        compare(run(P2=[1.0]), run(P2=[1.0]), {"P2": tolerance})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from cosim import Scenario

    folder = tmp_path_factory.mktemp("run")
    scenario = Scenario.load("paper")
    with FmuPlant(scenario) as plant:
        recorder = RerunRecorder(folder / "run.rrd")
        trajectory = simulate(plant, Proportional(scenario), 30, 1, recorder=recorder)
    trajectory.write_csv(folder / "trajectory.csv")
    return folder


def test_folder_csv_and_recording_of_a_run_are_equal(folder):
    csv = load_run(folder / "trajectory.csv")
    assert len(csv) == 30
    for other in (load_run(folder), load_run(folder / "run.rrd")):
        result = compare(csv, other)
        assert result.equal, result.lines()
        assert len(result.differences) == len(csv.signals)
