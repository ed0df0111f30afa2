"""A batch of RTI-NMPC as a differentiable layer of PyTorch or JAX."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from controllers.errors import ControllerError
from controllers.rti.nmpc import RtiNmpc

Layer = Callable[..., tuple[Any, Any]]


def torch_layer(controller: RtiNmpc) -> Layer:
    """`layer(states, theta, enforced=None, points=None)`: actions and values as PyTorch tensors.

    For states (K, n) they are π (K, m) and V (K,), or Q where actions (K, m) are enforced; θ is
    (n_θ,) or (K, n_θ), `points` those of `RtiNmpc.feedback_batch`. Outputs have the states' type;
    inside it is float64. Gradients are those of each QP that was solved, its point of linearisation
    held. A QP without a solution gives NaN, and zero gradients. Raises ControllerError without
    PyTorch, the extra `torch`.
    """
    torch = _module("torch")

    class RtiNmpcFunction(torch.autograd.Function):  # type: ignore[misc,name-defined]
        @staticmethod
        def forward(ctx: Any, *given: Any) -> Any:
            tensors = (each.detach().cpu() if torch.is_tensor(each) else each for each in given)
            wanted: dict[str, Any] = {"derivatives": any(ctx.needs_input_grad)}
            found = controller.feedback_batch(*tensors, **wanted)
            actions, values, *slopes = (torch.from_numpy(part).to(given[0]) for part in found)
            ctx.save_for_backward(*slopes)
            ctx.given = given
            return actions, values

        @staticmethod
        @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
        def backward(ctx: Any, *by: Any) -> Any:
            return *_pull_back(torch.einsum, ctx.saved_tensors, by, ctx.given), None

    def layer(states: Any, theta: Any, enforced: Any = None, points: Any = None) -> Any:
        return RtiNmpcFunction.apply(states, theta, enforced, points)

    return layer


def jax_layer(controller: RtiNmpc) -> Layer:
    """`torch_layer` for arrays of JAX, within `jit` and `grad` too.

    Raises ControllerError without JAX, the extra `jax`.
    """
    jax = _module("jax")
    n, m, size = controller.problem.n_states, controller.problem.n_actions, controller.theta.size
    shapes = (m,), (), (n,), (size,), (m,), (m, size), (m, n)

    def solve(derivatives: bool, states: Any, *others: Any) -> Any:
        def call(*given: Any) -> Any:
            found = controller.feedback_batch(*given, derivatives=derivatives)
            return tuple(part.astype(states.dtype) for part in found)

        results = [jax.ShapeDtypeStruct((len(states), *shape), states.dtype) for shape in shapes]
        wanted = tuple(results if derivatives else results[:2])
        return jax.pure_callback(call, wanted, states, *others, vmap_method="sequential")

    def forward(*given: Any) -> Any:
        actions, values, *slopes = solve(True, *given)
        return (actions, values), (slopes, given)

    def backward(kept: Any, by: Any) -> Any:
        slopes, given = kept
        points = jax.tree.map(jax.numpy.zeros_like, given[-1])
        return *_pull_back(jax.numpy.einsum, slopes, by, given), points

    @jax.custom_vjp  # type: ignore[untyped-decorator]
    def layer(states: Any, theta: Any, enforced: Any = None, points: Any = None) -> Any:
        return solve(False, states, theta, enforced, points)

    layer.defvjp(forward, backward)
    return layer  # type: ignore[no-any-return]


def _module(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ControllerError(f"{name} is missing: pip install 'rti-cosim[{name}]'") from error


def _pull_back(einsum: Any, slopes: Any, by: Any, given: Any) -> tuple[Any, Any, Any]:
    """Gradients in states, θ and enforced actions of `by`, those in the actions and values."""
    value_s, value_theta, value_a, policy_theta, policy_s = slopes
    _, theta, enforced, _ = given

    def pull(value: Any, policy: Any) -> Any:
        return einsum("k,ki->ki", by[1], value) + einsum("km,kmi->ki", by[0], policy)

    by_theta = pull(value_theta, policy_theta)
    by_enforced = None if enforced is None else by[0] + einsum("k,ki->ki", by[1], value_a)
    return pull(value_s, policy_s), by_theta.sum(0) if theta.ndim == 1 else by_theta, by_enforced
