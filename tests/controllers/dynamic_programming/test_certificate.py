import pytest

from controllers.dynamic_programming import (
    Figure,
    Settings,
    certify,
    objection,
    simulate_policy,
    solve,
    study,
)
from tests.helpers.linear_plant import SCALAR

PLANT = SCALAR.plant


@pytest.fixture(scope="module")
def optimum():
    return solve(PLANT, Settings())


def test_the_simulated_mean_cost_is_the_linear_regulators(optimum):
    mean, half_width = simulate_policy(PLANT, optimum, paths=400, steps=1000)
    exact = SCALAR.mean_cost(SCALAR.riccati()[1])
    assert half_width < 0.01 * exact
    assert abs(mean - exact) < 2 * half_width


def test_a_study_is_certified_by_what_it_found(optimum):
    rows = study(PLANT, Settings(), optimum)
    certified = certify(PLANT, rows, paths=200, steps=500)
    figures = certified.certificate
    assert [figure.name for figure in figures] == ["solution", "refinement", "simulation"]
    assert certified.gain == rows[1].optimum.gain
    assert [figure.value for figure in figures[:2]] == [optimum.gain, rows[1].optimum.gain]
    # So short a simulation cannot certify.
    assert objection(figures) is not None


def against(search=None, **values):
    given = {"solution": 1000.0, "refinement": 1000.2, "simulation": 999.9} | values
    figures = [Figure(name, x, x - 0.1, x + 0.1) for name, x in given.items() if x is not None]
    if search is not None:
        figures.append(Figure("policy search", search, search - 0.1, search + 0.1))
    return objection(figures)


def test_figures_that_agree_have_no_objection():
    assert against() is None
    assert against(search=1003.0) is None
    assert against(search=999.8) is None


@pytest.mark.parametrize("name", ["refinement", "simulation"])
def test_a_figure_that_was_not_made_is_named(name):
    assert against(**{name: None}) == f"not made: {name}"


@pytest.mark.parametrize("name", ["solution", "refinement", "simulation"])
def test_figures_apart_are_no_optimum(name):
    assert "apart, more than 0.05 %" in against(**{name: 1000.8})


def test_a_search_below_the_solution_is_an_objection():
    assert "a policy search found 999.00" in against(search=999.0)
