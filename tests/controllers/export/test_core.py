"""The exported controller against `RtiNmpc` in the loop with the plant."""

import sys
from pathlib import Path

import numpy as np
import pytest

from controllers import Parameters, Problem, RtiNmpc
from controllers.errors import ControllerError
from controllers.export import core
from controllers.export.core import STACK_LIMIT
from controllers.factories import naive, tuned
from controllers.theta import ThetaBlocks
from cosim import FmuPlant, Scenario
from tests.helpers.compiled import CompiledController
from tests.helpers.random_problems import Case, InUnits
from tests.helpers.sampling import evaporator_problem, random_parameters

ACTION = 1e-9
EXPLORED, DEVIATION = 0.1, 20.0


def _learnt(scenario: Scenario) -> Parameters:
    """θ about as far from naive as learning goes, with slack weights and bounds of its own."""
    problem = Problem.from_scenario(scenario)
    blocks = ThetaBlocks.from_problem(problem, slack_weights=True)
    return random_parameters(problem, blocks, np.random.default_rng(7))


THETAS = {
    "naive": lambda scenario: naive(scenario).parameters,
    "tuned": lambda scenario: tuned(scenario).parameters,
    "learnt": _learnt,
}


def _worst(scenario: Scenario, theta: Parameters, hessian: str, samples: int, folder: Path):
    """Largest differences of action, value and predictions over a run with exploration."""
    problem = Problem.from_scenario(scenario)
    ours = RtiNmpc(problem, theta, hessian=hessian)
    exported = CompiledController(folder, core(problem, theta, hessian))
    lower, upper = scenario.action_lower, scenario.action_upper
    rng, worst = np.random.default_rng(0), np.zeros(4)
    with FmuPlant(scenario) as plant:
        s = plant.reset(1)
        for k in range(samples):
            ours.prepare()
            solution, found = ours.feedback(s), exported.sample(s)
            action = np.clip(solution.action, lower, upper)
            assert found["status"] == 0
            assert found["residual"] < 1e-9
            differences = [
                np.abs(found["action"] - action).max(),
                abs(found["value"][0] / solution.value - 1),
                np.abs(found["x"] - solution.predicted_states.reshape(-1)).max(),
                np.abs(found["u"] - solution.predicted_actions.reshape(-1)).max(),
            ]
            worst = np.maximum(worst, differences)
            assert worst[0] < ACTION, k
            if rng.random() < EXPLORED:
                action = np.clip(action + DEVIATION * rng.standard_normal(2), lower, upper)
            s = plant.step(action).s
    return worst


CASES = [
    ("paper", "tuned", "gauss-newton", 300),
    ("fast-sampling", "learnt", "exact", 300),
]
for _scenario in ("paper", "fast-sampling", "fouled"):
    for _theta, _hessian in (("tuned", "gauss-newton"), ("learnt", "exact")):
        CASES.append(pytest.param(_scenario, _theta, _hessian, 2000, marks=pytest.mark.slow))


@pytest.mark.parametrize(("scenario", "theta", "hessian", "samples"), CASES)
def test_it_gives_the_actions_of_the_python_controller(
    tmp_path: Path, scenario: str, theta: str, hessian: str, samples: int
) -> None:
    loaded = Scenario.load(scenario)
    worst = _worst(loaded, THETAS[theta](loaded), hessian, samples, tmp_path)
    assert worst[1:].max() < 1e-6


@pytest.mark.campaign
@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
@pytest.mark.parametrize("theta", THETAS)
@pytest.mark.parametrize("scenario", ["paper", "fast-sampling", "fouled"])
def test_a_hundred_thousand_samples_agree(
    tmp_path: Path, scenario: str, theta: str, hessian: str
) -> None:
    """The exact Hessian, ten times slower in Python, for a tenth of the samples."""
    loaded = Scenario.load(scenario)
    samples = 100_000 if hessian == "gauss-newton" else 10_000
    worst = _worst(loaded, THETAS[theta](loaded), hessian, samples, tmp_path)
    print(f"\n{scenario} {theta} {hessian} {samples}: action {worst[0]:.1e} value {worst[1]:.1e}")


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> CompiledController:
    """A controller with the shortest horizon, which compiles fast; under the sanitizers."""
    problem = evaporator_problem(horizon=1)
    flags = ("-fsanitize=undefined,float-cast-overflow", "-fno-sanitize-recover=all")
    return CompiledController(
        tmp_path_factory.mktemp("core"), core(problem, Parameters.naive(problem)), *flags
    )


def test_a_sample_without_a_solution_repeats_the_action_and_forgets_the_guess(small) -> None:
    problem = evaporator_problem(horizon=1)
    small.reset()
    before = small.sample(np.array([26.0, 50.0]))
    assert before["status"] == 0
    good, slices = small.theta.copy(), Parameters.naive(problem).blocks.slices
    small.theta[slices["B_l"]] *= -1
    bad = small.sample(np.array([24.0, 49.0]))
    assert (bad["status"], bad["failures"]) == (1, 1)
    assert np.array_equal(bad["action"], before["action"])
    assert small.sample(np.array([np.nan, 49.0]))["status"] in (1, 3)
    small.theta[:] = good
    after = small.sample(np.array([25.5, 50.0]))
    small.reset()
    fresh = small.sample(np.array([25.5, 50.0]))
    assert np.array_equal(after["action"], fresh["action"])
    assert after["failures"] == 2


@pytest.mark.parametrize("hessian", ["gauss-newton", "exact"])
def test_in_manual_it_goes_on_from_the_operators_action(tmp_path: Path, hessian: str) -> None:
    problem, rng = evaporator_problem(horizon=3), np.random.default_rng(3)
    theta = Parameters.naive(problem)
    ours = RtiNmpc(problem, theta, hessian=hessian)
    exported = CompiledController(tmp_path, core(problem, theta, hessian))
    for k in range(60):
        s, manual = rng.normal((25.5, 50.0), (1.0, 2.0)), k % 6 in (2, 3, 4)
        a = rng.normal(problem.reference_action, 100.0) if manual else None
        found, applied = exported.sample(s, a), None
        if manual:
            applied = np.clip(a, problem.action_lower, problem.action_upper)
            np.testing.assert_array_equal(found["action"], applied)
        ours.prepare()
        solution = ours.feedback(s, applied)
        np.testing.assert_allclose(found["action"], solution.action, rtol=0, atol=ACTION)
        np.testing.assert_allclose(found["value"], solution.value, rtol=1e-9)
        np.testing.assert_allclose(found["x"], solution.predicted_states.ravel(), atol=1e-8)


def test_in_manual_the_action_does_not_wait_for_a_solution(small) -> None:
    small.reset()
    held = small.sample(np.array([np.nan, 50.0]), np.array([210.0, np.nan]))
    assert (held["status"], held["failures"]) == (3, 1)
    expected = [210.0, evaporator_problem(horizon=1).reference_action[1]]
    assert held["action"].tolist() == expected
    assert small.sample(np.array([np.nan, 50.0]))["action"].tolist() == expected


def test_an_ill_posed_theta_is_a_failure_with_the_reference_action(small) -> None:
    problem = evaporator_problem(horizon=1)
    small.reset()
    good, slices = small.theta.copy(), Parameters.naive(problem).blocks.slices
    small.theta[slices["x_l"]] = 1000.0
    found = small.sample(np.array([26.0, 50.0]))
    small.theta[:] = good
    assert found["status"] == 4
    assert np.array_equal(found["action"], problem.reference_action)


def test_an_unknown_hessian_and_too_long_a_horizon_are_refused() -> None:
    problem = evaporator_problem()
    with pytest.raises(ControllerError):
        core(problem, Parameters.naive(problem), "unknown")
    problem = evaporator_problem(horizon=60)
    with pytest.raises(ControllerError):
        core(problem, Parameters.naive(problem))


@pytest.mark.parametrize(
    ("horizon", "hessian"),
    [
        (10, "gauss-newton"),
        *(pytest.param(horizon, "exact", marks=pytest.mark.slow) for horizon in (2, 32)),
    ],
)
def test_no_controller_takes_more_stack_than_the_limit_that_refuses_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, horizon: int, hessian: str
) -> None:
    """The estimate holds against the compiler's own count of the longest chain of calls."""
    problem = evaporator_problem(horizon=horizon)
    made = core(problem, Parameters.naive(problem), hessian)
    CompiledController(tmp_path, made, "-O2", "-fstack-usage")
    frames = {}
    for path in tmp_path.glob("*.su"):
        for line in path.read_text().splitlines():
            place, size, _ = line.split("\t")
            frames[place.rpartition(":")[2].partition(".")[0]] = int(size)
    # `core_sample` calls what solves, and that a stage's function of the read-out.
    called = sorted(size for name, size in frames.items() if name != "core_sample")
    used = frames["core_sample"] + sum(called[-2:])
    monkeypatch.setattr(sys.modules["controllers.export.core"], "STACK_LIMIT", used)
    with pytest.raises(ControllerError, match="kB of stack a sample"):
        core(problem, Parameters.naive(problem), hessian)
    assert used < STACK_LIMIT


def test_an_inaccurate_solution_is_none(tmp_path: Path) -> None:
    """An unstable mode grows by e²⁰ over the horizon; the condensed QP's rounding grows with it."""
    given = InUnits(Case(seed=3, n=1, m=1, horizon=40, growth=0.5))
    made = CompiledController(tmp_path, core(given.problem, given.parameters(given.theta)))
    found = made.sample(given.drawn.s)
    assert found["status"] in (1, 5)  # by rounding the QP may not be convex, either
    assert found["failures"] == 1
    assert np.array_equal(found["action"], given.problem.reference_action)
