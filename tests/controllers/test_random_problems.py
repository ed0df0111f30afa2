"""Right, or a refusal: random problems in random units against a solver of the tests' own.

`tests.helpers.random_problems` has the problems and the solver, which takes the QP stage by stage.
"""

from collections import Counter

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, settings
from hypothesis import strategies as st

from controllers import ConvergedNmpc, QpError, RtiNmpc, functions
from controllers.export import core
from tests.helpers.compiled import CompiledController
from tests.helpers.random_problems import Case, InUnits, Oracle

VALUE, ACTION, SLOPE = 1e-7, 1e-6, 1e-6
"""Errors that count as right: of V to 1 + |V|, of π to its range, of derivatives to the largest."""
REFERENCE = 1e-10
"""Residual above which the other solver's answer is no reference."""
HESSIANS = ("gauss-newton", "exact")
BACKENDS = ("daqp", "proxqp", "qpsolvers:clarabel", "qpsolvers:quadprog")


@st.composite
def cases(draw, size=30, growth=0.0):
    """Cases of up to `size` variables and states in all, with modes up to `growth` a sample."""
    n, m = draw(st.integers(1, 8)), draw(st.integers(1, 4))
    horizon = draw(st.integers(1, min(40, max(1, size // (n + m)))))
    decade = st.integers(-6, 6).map(float)
    return Case(
        seed=draw(st.integers(0, 10**6)), n=n, m=m, horizon=horizon,
        growth=draw(st.floats(-1.5, growth)),
        bent=draw(st.sampled_from([0.0, 0.1, 0.3])),
        tight=draw(st.sampled_from([0.1, 1.0, 10.0])),
        far=draw(st.sampled_from([0.0, 0.5, 2.0])),
        discount=draw(st.sampled_from([0.9, 0.99, 1.0])),
        decades=tuple(draw(st.lists(decade, min_size=n + m, max_size=n + m))),
        cost_decade=draw(decade),
    )  # fmt: skip


def profile(examples):
    return settings(
        max_examples=examples, deadline=None, derandomize=True, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip


def controller(given, hessian="gauss-newton", backend="daqp"):
    made = RtiNmpc(given.problem, given.parameters(given.theta), hessian=hessian, backend=backend)
    made.prepare_at(given.point)
    return made


def compiled(given):
    made = RtiNmpc(given.problem, given.parameters(given.theta))
    made.compile()
    if made.functions != "compiled":
        pytest.skip("there is no C compiler")
    made.prepare_at(given.point)
    return made


def check(given, oracle, nmpc):
    """Compare V, π and Q with the oracle; what the controller answered: `right` or `refused`."""
    drawn, answers = given.drawn, Counter()
    for a in (None, drawn.a):
        expected = oracle.solve(given.theta, drawn.s, a)
        assume(expected.residual < REFERENCE)
        try:
            found = nmpc.feedback(drawn.s * given.state, None if a is None else a * given.action)
        except QpError:
            answers["refused"] += 1
            continue
        answers["right"] += 1
        error = abs(found.value / given.cost - expected.value)
        assert error <= VALUE * (1 + abs(expected.value)), (given.case, found.residual)
        error = np.abs(found.action / given.action - expected.action).max()
        assert error <= ACTION * given.case.tight, (given.case, found.residual)
    return answers


def check_slopes(given, oracle, nmpc):
    """Compare dV/dθ, dQ/dθ and dπ/dθ along a drawn direction with differences of both solvers."""
    drawn, theta = given.drawn, given.theta
    direction = drawn.direction[: theta.size] * np.maximum(np.abs(theta), 0.1)
    for a in (None, drawn.a):
        enforced = None if a is None else a * given.action
        nmpc.parameters = given.parameters(theta)
        nmpc.prepare_at(given.point)
        try:
            at = nmpc.feedback(drawn.s * given.state, enforced)
            weak = at.weakly_active or not at.licq
            slope = at.value_gradient / given.cost * given.factors @ direction
            policy = np.zeros(given.case.m)
            if a is None:
                policy = at.policy_jacobian * given.factors @ direction / given.action
        except QpError:
            continue
        base = oracle.solve(theta, drawn.s, a)
        if weak or base.residual > REFERENCE or base.margin < 1e-4:
            continue
        h = 1e-5

        def ends(read, h=h):
            return (8 * (read(h) - read(-h)) - (read(2 * h) - read(-2 * h))) / (12 * h)

        def others(h, a=a, base=base):
            answer = oracle.solve(theta + h * direction, drawn.s, a)
            assume(answer.residual < REFERENCE and answer.active == base.active)
            return np.append(answer.action, answer.value)

        def ours(h, enforced=enforced):
            nmpc.parameters = given.parameters(theta + h * direction)
            nmpc.prepare_at(given.point)
            answer = nmpc.feedback(drawn.s * given.state, enforced)
            return np.append(answer.action / given.action, answer.value / given.cost)

        wanted = np.append(policy, slope)
        noise = 1e-15 / h * (1 + abs(base.value)) * 1e2
        for read in (others, ours):
            found = ends(read)
            if a is not None:
                found[:-1] = 0.0
            size = 1 + np.abs(wanted).max()
            assert np.abs(found - wanted).max() <= SLOPE * size + noise, (given.case, read.__name__)


def answers_of(solution, given):
    """All that a solution says, in units of size one, by what an error is relative to."""
    m = given.case.m
    price = given.cost / given.state
    found = {
        "value": np.array([solution.value / given.cost]),
        "action": solution.action / given.action,
        "states": solution.predicted_states / given.state,
        "costates": solution.costates / price,
        "gradient": solution.value_gradient * given.factors / given.cost,
    }
    if not solution.enforced:
        found["policy"] = solution.policy_jacobian * given.factors / given.action[:, None]
        by_state = solution.policy_state_jacobian * given.state
        found["policy by state"] = by_state / given.action[:, None]
    else:
        found["slope"] = solution.action_gradient * given.action / given.cost
    assert found["action"].shape == (m,)
    return found


def check_units(case, make):
    """The same problem in units of size one and in the case's: the same answers, or refusals."""
    plain = InUnits(Case(**{**vars(case), "decades": (), "cost_decade": 0.0}))
    other = InUnits(case)
    drawn, seen = plain.drawn, []
    for counted in (plain, other):
        nmpc, said = make(counted), []
        for a in (None, drawn.a):
            try:
                enforced = None if a is None else a * counted.action
                solution = nmpc.feedback(drawn.s * counted.state, enforced)
            except QpError as error:
                said.append(error.status)
                continue
            said.append((answers_of(solution, counted), solution.weakly_active, solution.licq))
        seen.append(said)
    for one, two in zip(*seen, strict=True):
        if isinstance(one, str) or isinstance(two, str):
            assert isinstance(one, str) and isinstance(two, str), (case, one, two)
            continue
        assert one[1:] == two[1:], case
        if one[1] or not one[2]:
            continue
        for name, value in one[0].items():
            size = 1e-3 + np.abs(value).max()
            assert np.abs(value - two[0][name]).max() <= 1e-6 * size, (case, name)


EDGE = Case(seed=1, n=1, m=1, horizon=1)
BAD_UNITS = Case(seed=2, n=2, m=1, horizon=8, tight=0.5, far=0.5, decades=(-6.0, 6.0, 3.0))
LONG_UNSTABLE = Case(seed=3, n=1, m=1, horizon=40, growth=0.5)


@example(EDGE, "exact")
@example(BAD_UNITS, "gauss-newton")
@example(LONG_UNSTABLE, "gauss-newton")
@given(cases(16, 0.3), st.sampled_from(HESSIANS))
@profile(2)
def test_a_value_is_right_or_refused(case, hessian):
    given = InUnits(case)
    check(given, Oracle(given, hessian), controller(given, hessian))


@example(BAD_UNITS, "gauss-newton")
@given(cases(12), st.sampled_from(HESSIANS))
@profile(2)
def test_a_change_of_units_changes_no_answer(case, hessian):
    check_units(case, lambda given: controller(given, hessian))


@example(Case(seed=5, n=2, m=1, horizon=3, decades=(3.0, -3.0, 2.0)), "gauss-newton")
@given(cases(8), st.sampled_from(HESSIANS))
@profile(1)
def test_derivatives_are_those_of_the_answer(case, hessian):
    given = InUnits(case)
    check_slopes(given, Oracle(given, hessian), controller(given, hessian))


def every_property(case, count):
    """All properties of a case, for each Hessian and backend."""
    for hessian in HESSIANS:
        given = InUnits(case)
        oracle = Oracle(given, hessian)
        for backend in BACKENDS:
            count.update(check(given, oracle, controller(given, hessian, backend)))
        check_slopes(given, oracle, controller(given, hessian))
        for backend in ("daqp", "proxqp"):
            check_units(case, lambda given, h=hessian, b=backend: controller(given, h, b))


@pytest.mark.slow
def test_many_values_are_right_and_benign_ones_are_seldom_refused():
    count = Counter()

    @example(BAD_UNITS)
    @given(cases(12))
    @profile(1)
    def run(case):
        every_property(case, count)

    run()
    assert count["refused"] <= 0.02 * count["right"]


@pytest.mark.slow
@pytest.mark.parametrize("stagewise", [False, True])
def test_compiled_code_is_right_or_refuses(monkeypatch, stagewise):
    monkeypatch.delenv("COSIM_COMPILE", raising=False)
    monkeypatch.setattr(functions, "FLAGS", ("-O0", *functions.FLAGS[1:]))
    if stagewise:
        monkeypatch.setattr("controllers.rti.nmpc.solves_by_stage", lambda problem: True)

    @example(BAD_UNITS)
    @example(LONG_UNSTABLE)
    @given(cases(12, 0.3))
    @profile(2)
    def run(case):
        given = InUnits(case)
        check(given, Oracle(given, "gauss-newton"), compiled(given))

    run()


@pytest.mark.slow
@pytest.mark.parametrize("case", [BAD_UNITS, EDGE])
@pytest.mark.parametrize("hessian", HESSIANS)
def test_the_exported_controller_is_right_or_refuses(tmp_path, case, hessian):
    given = InUnits(case)
    parameters = given.parameters(given.theta)
    exported = CompiledController(tmp_path, core(given.problem, parameters, hessian))
    ours = RtiNmpc(given.problem, parameters, hessian=hessian)
    ours.prepare()
    s = given.drawn.s * given.state
    expected, found = ours.feedback(s), exported.sample(s)
    assert found["status"] == 0
    assert np.abs(found["action"] - expected.action).max() <= 1e-9 * given.action.max()
    assert abs(found["value"][0] - expected.value) <= 1e-9 * (given.cost + abs(expected.value))


@pytest.mark.slow
@given(cases(8))
@profile(2)
def test_converged_nmpc_is_the_same_in_other_units(case):
    def make(given):
        nmpc = ConvergedNmpc(given.problem, given.parameters(given.theta))
        nmpc.prepare_at(given.point)
        return nmpc

    check_units(case, make)


@pytest.mark.campaign
def test_a_campaign_of_random_problems():
    count = Counter()

    @given(cases(70, 0.5))
    @settings(profile(200), derandomize=False)
    def run(case):
        every_property(case, count)

    run()
