import pytest

from controllers.dynamic_programming.policy_iteration import Certificate, Figure


def certificate(search=None, **values):
    given = {"solution": 1000.0, "refinement": 1000.2, "simulation": 999.9} | values
    figures = [Figure(name, x, x - 0.1, x + 0.1) for name, x in given.items() if x is not None]
    if search is not None:
        figures.append(Figure("policy search", search, search - 0.1, search + 0.1))
    return Certificate(tuple(figures))


def test_figures_that_agree_have_no_objection():
    assert certificate().objection() is None
    assert certificate(search=1003.0).objection() is None
    assert certificate(search=999.8).objection() is None


@pytest.mark.parametrize("name", ["refinement", "simulation"])
def test_a_figure_that_was_not_made_is_named(name):
    assert certificate(**{name: None}).objection() == f"not made: {name}"


@pytest.mark.parametrize("name", ["solution", "refinement", "simulation"])
def test_figures_apart_are_no_optimum(name):
    assert "apart, more than 0.05 %" in certificate(**{name: 1000.8}).objection()


def test_a_search_below_the_solution_is_an_objection():
    assert "a policy search found 999.00" in certificate(search=999.0).objection()
