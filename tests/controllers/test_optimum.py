from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import scipy.stats

from controllers import OptimalPolicy, Quantity, evaporator, factories
from controllers.dynamic_programming import BellmanOperator, Settings, objection
from controllers.errors import OptimumError
from controllers.optimum import SHIPPED_OPTIMA, optimum_key, read_optimum
from controllers.periodic_optimum import periodic_key, periodic_plant, read_periodic
from controllers.problem import PlantProblem, Problem
from cosim import FmuPlant, Scenario, simulate

PRESETS = ("paper", "fast-sampling", "nominal", "fouled", "mismatched")
STOCHASTIC = tuple(name for name in PRESETS if name != "nominal")
# The first two were found by multilinear interpolation and confirmed by an independent dynamic
# programme, whose refinement was 0.0015 %.
GAINS = {
    "paper": pytest.approx(6337.87, rel=3e-5),
    "fast-sampling": pytest.approx(6225.00, rel=3e-5),
    "holdup": pytest.approx(6403.809, rel=1e-6),
    "slow-sampling": pytest.approx(6508.791, rel=1e-6),
}


@pytest.fixture(scope="module")
def policies():
    return {name: OptimalPolicy.from_scenario(Scenario.load(name)) for name in PRESETS}


@pytest.fixture(scope="module")
def policy(policies):
    return policies["paper"]


@pytest.mark.parametrize("name", PRESETS)
def test_presets_policies_are_shipped(name):
    plant = PlantProblem.from_scenario(Scenario.load(name))
    key = optimum_key(plant, Settings())
    path = SHIPPED_OPTIMA / f"{key}.npz"
    assert path.is_file(), "equations or solver changed: solve anew with `cosim optimum`"
    assert path.stat().st_size < 300_000
    certificate = read_optimum(path, key).certificate
    assert certificate
    assert objection(certificate) is None


def test_the_optimum_of_the_prices_is_shipped():
    """A policy for each of 1440 phases, with the certificate that `--refine` has made."""
    key = periodic_key(periodic_plant(Scenario.load("prices")), Settings())
    path = SHIPPED_OPTIMA / f"{key}.npz"
    assert path.is_file(), "solve anew with `cosim optimum -s prices --refine`"
    assert path.stat().st_size < 1_000_000
    solution = read_periodic(path, key)
    assert objection(solution.certificate) is None
    assert solution.gain == pytest.approx(6336.05, abs=0.01)


@pytest.mark.parametrize("name", GAINS)
def test_the_optimum_that_is_shipped_is_the_known_one(name):
    key = optimum_key(PlantProblem.from_scenario(Scenario.load(name)), Settings())
    assert read_optimum(SHIPPED_OPTIMA / f"{key}.npz", key).gain == GAINS[name]


@pytest.mark.parametrize("name", PRESETS)
def test_bounds_enclose_the_mean_cost_within_a_thousandth(policies, name):
    optimum = policies[name].optimum
    slack = 1e-9 * optimum.gain
    assert optimum.lower - slack <= optimum.gain <= optimum.upper + slack
    assert optimum.upper - optimum.lower < 1e-3 * optimum.gain
    assert optimum.edge_mass < 1e-6


def test_without_disturbance_the_optimum_is_the_steady_state(policies):
    assert policies["nominal"].gain == pytest.approx(6210.384509575885, rel=1e-9)


def test_feedback_on_a_grid_state_is_the_table(policy):
    grid = policy.optimum.grid
    for index in np.random.default_rng(0).integers(grid.size, size=20):
        s = grid.points[index]
        solution = policy.feedback(s)
        np.testing.assert_allclose(solution.action, policy.optimum.actions[index], rtol=1e-14)
        expected = policy.optimum.W[index] + policy.problem.penalty(s)
        assert solution.value == pytest.approx(expected, rel=1e-12, abs=1e-9)
        assert solution.status == "solved"


def test_no_action_is_better_than_the_policys(policy):
    generator = np.random.default_rng(2)
    plant = PlantProblem.from_scenario(Scenario.load("paper"))
    operator = BellmanOperator(plant, policy.optimum.accuracy)
    for s in generator.uniform([25, 46], [29, 56], (20, 2)):
        best = policy.action_value(s, policy.feedback(s).action)
        # Interpolation between grid states: a fraction of a cost unit out of 6338 a sample.
        assert best == pytest.approx(policy.feedback(s).value, abs=0.5)
        actions, optimum = generator.uniform([100, 100], [400, 400], (20, 2)), policy.optimum
        smooth = operator.values(np.tile(s, (20, 1)), actions, optimum.grid, optimum.W)
        values = smooth - optimum.gain + policy.problem.penalty(s.tolist())
        assert values[0] == pytest.approx(policy.action_value(s, actions[0]), rel=1e-12)
        assert (values > best - 0.05).all()


def test_outside_the_grid_the_nearest_state_serves(policy):
    far = policy.feedback([500.0, 50.0])
    near = policy.feedback([policy.optimum.grid.axes[0][-1], 50.0])
    np.testing.assert_array_equal(far.action, near.action)
    assert (far.status, near.status) == ("clamped", "solved")


def paired(scenario, controllers, seeds, steps):
    """J per controller and seed, (controllers, seeds); samples before the 50th are left out."""
    J = np.zeros((len(controllers), seeds))
    with FmuPlant(scenario) as plant:
        for row, name in zip(J, controllers, strict=True):
            controller = getattr(factories, name)(scenario)
            for seed in range(seeds):
                trajectory = simulate(plant, controller, steps, 1000 + seed)
                row[seed] = (trajectory["stage_cost"] + trajectory["penalty"])[50:].mean()
    return J


@pytest.mark.slow
@pytest.mark.parametrize("name", STOCHASTIC)
def test_the_fmus_mean_cost_is_the_gain(policies, name):
    (J,) = paired(Scenario.load(name), ["optimal"], seeds=20, steps=5000)
    half_width = scipy.stats.t.ppf(0.995, 19) * J.std(ddof=1) / np.sqrt(20)
    assert half_width < 0.002 * policies[name].gain
    assert abs(J.mean() - policies[name].gain) < half_width


@pytest.mark.parametrize(
    ("name", "seeds", "steps"),
    [
        pytest.param("paper", 10, 600, marks=pytest.mark.campaign),
        # Here a difference is twenty times the half-width of its interval.
        pytest.param("mismatched", 4, 300, marks=pytest.mark.slow),
    ],
)
def test_no_other_controller_has_a_lower_cost(name, seeds, steps):
    names = ["optimal", "naive", "tuned", "converged"]
    J = paired(Scenario.load(name), names, seeds, steps)
    for other in J[1:]:
        difference = other - J[0]
        quantile = scipy.stats.t.ppf(0.975, seeds - 1)
        assert difference.mean() > quantile * difference.std(ddof=1) / np.sqrt(seeds)


def test_a_plant_that_the_model_cannot_describe_is_refused():
    paper = Scenario.load("paper")
    with pytest.raises(OptimumError):
        factories.optimal(paper.replace({"plant": {"parameters": {"h2": 1.0}}}))
    swapped = {"plant": {"states": ["P2", "X2"], "mapping": {"initial_state": []}}}
    with pytest.raises(OptimumError):
        factories.optimal(paper.replace(swapped))


def test_plant_parameters_of_the_scenario_reach_the_model():
    scenario = Scenario.load("paper").replace({"plant": {"parameters": {"UA2": 7.0}}})
    plant = PlantProblem.from_scenario(scenario)
    names = [quantity.name for quantity in plant.problem.model.parameters]
    assert plant.parameters[names.index("UA2")] == 7.0


def leaky_evaporator():
    """The evaporator with a leak that the controller's model knows nothing of."""
    model = evaporator.model()
    return replace(
        model,
        name="leaky",
        parameters=(*model.parameters, Quantity("leak", "kPa/min", 0.0)),
        ode=lambda x, u, d, p: model.ode(x, u, d, p[:-1]) + ca.vertcat(0, p[-1]),
        economic_cost=lambda x, u, d, p: model.economic_cost(x, u, d, p[:-1]),
    )


def test_a_plants_own_model_serves_where_the_controllers_lacks_a_parameter():
    changes = {"plant": {"parameters": {"leak": 0.1}, "model": f"{__name__}:leaky_evaporator"}}
    scenario = Scenario.load("paper").replace(changes)
    plant = PlantProblem.from_scenario(scenario)
    assert plant.problem.model.name == "leaky"
    assert plant.parameters[-1] == 0.1
    assert Problem.from_scenario(scenario).model.name == "evaporator"
    with pytest.raises(OptimumError):
        PlantProblem.from_scenario(
            Scenario.load("paper").replace({"plant": {"parameters": {"leak": 0.1}}})
        )


def test_plant_of_four_states_is_refused_before_hours_of_work():
    with pytest.raises(OptimumError, match=r"4 states need a grid of .* = 910224 points"):
        OptimalPolicy.from_scenario(Scenario.load("tanks"))
