"""The layers of PyTorch and JAX: their gradients by finite differences of themselves."""

import sys

import numpy as np
import pytest

from controllers import ControllerError, RtiNmpc, ThetaBlocks, functions
from controllers.layers import jax_layer, torch_layer
from tests.helpers.differences import natural_scale
from tests.helpers.sampling import (
    evaporator_problem,
    random_parameters,
    random_point,
)

COUNT = 3
ACTION, VALUE = 100.0, 1e6  # what the outputs are divided by


@pytest.fixture(params=["compiled", "interpreted"])
def case(request, monkeypatch):
    """A controller; states, θ and actions, each with the size of a small change; points."""
    monkeypatch.delenv("COSIM_COMPILE", raising=False)
    monkeypatch.setattr(functions, "FLAGS", ("-O0", *functions.FLAGS[1:]))  # as in test_engine
    problem, rng = evaporator_problem(), np.random.default_rng(3)
    blocks = ThetaBlocks.from_problem(problem, slack_weights=True, model_parameters=("UA2",))
    controller = RtiNmpc(problem, random_parameters(problem, blocks, rng))
    if request.param == "compiled":
        controller.compile()
        if controller.functions != "compiled":
            pytest.skip("no C compiler")
    scales = np.ones(2), natural_scale(controller.parameters), 10 * np.ones(2)
    centres = problem.reference_state, controller.theta, problem.reference_action
    given = [
        (centre + 0.1 * scale * rng.normal(size=(COUNT, centre.size)), scale)
        for centre, scale in zip(centres, scales, strict=True)
    ]
    points = [random_point(problem, rng) for _ in range(COUNT)]
    return controller, given, type(points[0])(*map(np.stack, zip(*points, strict=True)))


def outputs(layer, given, points, *z):
    """Actions and values, of their own size about 1, at changes z of the inputs, about 1 too."""
    changed = (middle + scale * change for (middle, scale), change in zip(given, z, strict=False))
    actions, values = layer(*changed, points=points)
    return actions / ACTION, values / VALUE


@pytest.mark.parametrize("enforced", [False, True])
def test_torch_finds_the_gradients_right(case, enforced):
    torch = pytest.importorskip("torch")
    controller, given, points = case
    given = [tuple(map(torch.tensor, each)) for each in given]
    z = [torch.zeros(COUNT, scale.numel()).double().requires_grad_() for _, scale in given]

    def function(*z):
        return outputs(torch_layer(controller), given, points, *z)

    assert torch.autograd.gradcheck(function, z[: 2 + enforced], eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.slow  # CI has JAX for the slow tests, PyTorch nowhere
@pytest.mark.parametrize("enforced", [False, True])
def test_jax_finds_the_gradients_right(case, enforced):
    jax = pytest.importorskip("jax")
    from jax.test_util import check_grads

    controller, given, points = case
    with jax.enable_x64(True):
        z = [np.zeros((COUNT, scale.size)) for _, scale in given]

        @jax.jit
        def function(*z):
            return outputs(jax_layer(controller), given, points, *z)

        check_grads(function, z[: 2 + enforced], 1, ["rev"], eps=1e-6, atol=1e-7, rtol=1e-5)


def test_one_theta_serves_all_and_an_unsolved_qp_spoils_no_gradient(case):
    torch = pytest.importorskip("torch")
    controller, [(states, _), (theta, _), _], _ = case
    layer = torch_layer(controller)
    each = torch.tensor(np.broadcast_to(theta[0], theta.shape).copy(), requires_grad=True)
    one = torch.tensor(theta[0], requires_grad=True)
    before = controller.linearisation_point, controller.theta
    layer(torch.tensor(states), each)[1].sum().backward()
    layer(torch.tensor(states), one)[1].sum().backward()
    assert torch.allclose(each.grad.sum(0), one.grad, rtol=1e-12)
    one.grad = None
    actions, values = layer(torch.tensor(np.vstack([states, [np.nan, 50.0]])), one)
    assert torch.isnan(values).tolist() == [False, False, False, True]
    (values[:-1].sum() + 0 * torch.nan_to_num(actions[-1]).sum()).backward()
    assert torch.allclose(each.grad.sum(0), one.grad, rtol=1e-12)
    for kept, now in zip(before, (controller.linearisation_point, controller.theta), strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(kept, now, strict=True))


def test_the_outputs_have_the_precision_of_the_states(case):
    torch = pytest.importorskip("torch")
    controller, [(states, _), (theta, _), _], _ = case
    s = torch.tensor(states, dtype=torch.float32)
    actions, values = torch_layer(controller)(s, torch.tensor(theta, requires_grad=True))
    assert actions.dtype == values.dtype == torch.float32
    expected = controller.feedback_batch(s, theta=theta).action
    np.testing.assert_allclose(actions.detach(), expected, rtol=1e-6)


@pytest.mark.parametrize("make", [torch_layer, jax_layer])
def test_a_missing_package_is_named_with_its_extra(make, monkeypatch):
    name = make.__name__.removesuffix("_layer")
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ControllerError, match=rf"pip install 'rti-cosim\[{name}\]'"):
        make(None)
