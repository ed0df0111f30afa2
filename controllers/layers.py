"""A batch of RTI-NMPC as a differentiable layer of PyTorch or JAX."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from controllers.errors import ControllerError
from controllers.rti.nmpc import RtiNmpc

Layer = Callable[..., tuple[Any, Any]]

# The arrays of a `BatchSolution` in its order, as both packages get them: first what the layer
# returns, then the derivatives that its backward pass contracts.
LAYER_OUTPUTS = ("action", "value")
DERIVATIVES = (
    "state_gradient",
    "value_gradient",
    "action_gradient",
    "policy_jacobian",
    "policy_state_jacobian",
)


def torch_layer(controller: RtiNmpc) -> Layer:
    """`layer(states, theta, enforced=None, points=None)`: actions and values as PyTorch tensors.

    For states (K, n) they are π (K, m) and V (K,), or Q where actions (K, m) are enforced; θ is
    (n_θ,) or (K, n_θ), `points` those of `RtiNmpc.feedback_batch`. Outputs have the states' type;
    inside it is float64. Gradients are those of each QP that was solved, its point of linearisation
    held. A QP without a solution gives NaN, and zero gradients. Raises ControllerError without
    PyTorch, the extra `torch`.
    """
    torch = _module("torch")

    def to_numpy(argument: Any) -> Any:
        # Gradients do not pass the solver: `backward` has them.
        if torch.is_tensor(argument):
            return argument.detach().cpu()
        return argument

    class RtiNmpcFunction(torch.autograd.Function):  # type: ignore[misc,name-defined]
        @staticmethod
        def forward(
            ctx: Any,
            states: Any,
            theta: Any,
            enforced: Any,
            points: Any,
        ) -> Any:
            # Derivatives take several times the solution: only where somebody asks.
            needed = any(ctx.needs_input_grad)
            solution = controller.feedback_batch(
                to_numpy(states),
                to_numpy(theta),
                to_numpy(enforced),
                points,
                derivatives=needed,
            )

            def tensor(name: str) -> Any:
                array = getattr(solution, name)
                return torch.from_numpy(array).to(states)

            if needed:
                ctx.save_for_backward(*map(tensor, DERIVATIVES))
            # One θ for all rows gets the sum of its gradients, which its shape says.
            ctx.theta = theta
            ctx.enforced = enforced
            return tensor("action"), tensor("value")

        @staticmethod
        @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
        def backward(
            ctx: Any,
            by_action: Any,
            by_value: Any,
        ) -> Any:
            gradients = _pull_back(
                torch.einsum,
                ctx.saved_tensors,
                by_action,
                by_value,
                ctx.theta,
                ctx.enforced,
            )
            # The points are held.
            return *gradients, None

    def layer(
        states: Any,
        theta: Any,
        enforced: Any = None,
        points: Any = None,
    ) -> Any:
        return RtiNmpcFunction.apply(states, theta, enforced, points)

    return layer


def jax_layer(controller: RtiNmpc) -> Layer:
    """`torch_layer` for arrays of JAX, within `jit` and `grad` too.

    Raises ControllerError without JAX, the extra `jax`.
    """
    jax = _module("jax")
    n = controller.problem.n_states
    m = controller.problem.n_actions
    size = controller.theta.size
    shapes = {
        "action": (m,),
        "value": (),
        "state_gradient": (n,),
        "value_gradient": (size,),
        "action_gradient": (m,),
        "policy_jacobian": (m, size),
        "policy_state_jacobian": (m, n),
    }

    def solve(derivatives: bool, states: Any, *others: Any) -> Any:
        """Arrays of the solution by JAX's callback, which must say their shapes beforehand."""
        names = list(LAYER_OUTPUTS)
        if derivatives:
            names += DERIVATIVES
        dtype = states.dtype

        def call(*arguments: Any) -> Any:
            solution = controller.feedback_batch(*arguments, derivatives=derivatives)
            arrays = [getattr(solution, name) for name in names]
            return tuple(array.astype(dtype) for array in arrays)

        # JAX traces shapes, not values: what a callback returns must be declared.
        results = []
        for name in names:
            shape = (len(states), *shapes[name])
            results.append(jax.ShapeDtypeStruct(shape, dtype))
        return jax.pure_callback(
            call,
            tuple(results),
            states,
            *others,
            vmap_method="sequential",
        )

    def forward(*arguments: Any) -> Any:
        action, value, *derivatives = solve(True, *arguments)
        return (action, value), (derivatives, arguments)

    def backward(saved: Any, by: Any) -> Any:
        derivatives, (_, theta, enforced, points) = saved
        by_action, by_value = by
        gradients = _pull_back(
            jax.numpy.einsum,
            derivatives,
            by_action,
            by_value,
            theta,
            enforced,
        )
        # The points are held: their gradient is zero, in the shape in which they came.
        by_points = jax.tree.map(jax.numpy.zeros_like, points)
        return *gradients, by_points

    @jax.custom_vjp  # type: ignore[untyped-decorator]
    def layer(
        states: Any,
        theta: Any,
        enforced: Any = None,
        points: Any = None,
    ) -> Any:
        return solve(False, states, theta, enforced, points)

    layer.defvjp(forward, backward)
    return layer  # type: ignore[no-any-return]


def _module(name: str) -> Any:
    try:
        return import_module(name)
    except ImportError as error:
        raise ControllerError(f"{name} is missing: pip install 'rti-cosim[{name}]'") from error


def _pull_back(
    einsum: Any,
    derivatives: Any,
    by_action: Any,
    by_value: Any,
    theta: Any,
    enforced: Any,
) -> tuple[Any, Any, Any]:
    """Gradients in states, θ and enforced actions of those in the layer's outputs.

    Args:
        einsum: The package's.
        derivatives: Arrays of `BatchSolution` by `DERIVATIVES`.
        by_action: Gradient in the actions, (K, m).
        by_value: Gradient in the values, (K,).
        theta: θ as it was given: one for all rows gets the sum of its rows' gradients.
        enforced: Actions as they were given, or None.

    Returns:
        Gradients of the shapes of states, θ and enforced actions; None for the last without these.
    """
    value_state, value_theta, value_action, policy_theta, policy_state = derivatives

    def pull(value: Any, policy: Any) -> Any:
        through_value = einsum("k,ki->ki", by_value, value)
        through_policy = einsum("km,kmi->ki", by_action, policy)
        return through_value + through_policy

    by_states = pull(value_state, policy_state)
    by_theta = pull(value_theta, policy_theta)
    if theta.ndim == 1:
        by_theta = by_theta.sum(0)
    by_enforced = None
    if enforced is not None:  # the action that the layer returns is the enforced one
        by_enforced = by_action + einsum("k,ki->ki", by_value, value_action)
    return by_states, by_theta, by_enforced
