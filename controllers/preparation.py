"""A sample's QP in CasADi: linearise and condense, then put the state in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from controllers.errors import ControllerError, ModelError, ModelWarning
from controllers.functions import (
    Definition,
    StackedFunction,
    define,
    matrix_symbols,
    scalar_symbols,
    stage_function,
)
from controllers.model import Integration, measure_integration, runge_kutta
from controllers.problem import Problem, built_once, of_kind
from controllers.qp import SoftQp
from controllers.readout import readout, soft_bounds
from controllers.theta import (
    Parameters,
    Symbols,
    ThetaBlocks,
    given_size,
    moved_references,
    stage_columns,
    symbolic_given,
    symbolic_stage,
)
from cosim.core.errors import warn
from cosim.core.protocols import Matrix, Vector
from cosim.core.validation import instead

SOLVED_RESIDUAL = 1e-8
"""Largest KKT residual of a QP that counts as solved."""


def sampled_jacobian(
    problem: Problem,
    x: ca.SX,
    u: ca.SX,
    parameters: ca.SX,
    disturbance: ca.SX | None = None,
) -> tuple[ca.SX, ca.SX]:
    """State after one sample of the nominal model, and its Jacobian with respect to (x, u).

    The variational equation goes through the same RK4 steps as the state, so the Jacobian is that
    of the discrete map itself, at fewer operations than differentiating the map.

    Args:
        problem: The problem, whose model is integrated over one sample in its `substeps`.
        x: State at the sample's start in the model's units, (n,).
        u: Action held over the sample, (m,).
        parameters: Physical parameters of the model, (n_p,).
        disturbance: Disturbance in the place of the nominal one, (n_d,).

    Returns:
        The state after the sample (n,), and its Jacobian (n, n+m).
    """
    n = problem.n_states
    m = problem.n_actions
    model = problem.model

    # One function of the rate and its derivatives, called at each of the four points of a step.
    if disturbance is None:
        disturbance = ca.SX(ca.DM(model.nominal_disturbance))
    free = ca.symvar(ca.vertcat(parameters, disturbance))
    state = ca.SX.sym("at", n)
    action = ca.SX.sym("held", m)
    rate = model.ode(state, action, disturbance, parameters)
    rate_by_state = ca.jacobian(rate, state)
    rate_by_action = ca.jacobian(rate, action)
    evaluate = ca.Function(
        "slope",
        [state, action, *free],
        [rate, rate_by_state, rate_by_action],
    )

    def rate_and_variation(columns: ca.SX) -> ca.SX:
        """d/dt of (x, ∂x/∂(x, u)), whose columns are side by side."""
        present_x = columns[:, 0]
        jacobian = columns[:, 1:]
        value, by_state, by_action = evaluate(present_x, u, *free)
        # d/dt J = ∂ẋ/∂x J + (0, ∂ẋ/∂u).
        forcing = ca.horzcat(ca.SX(n, n), by_action)
        variation = by_state @ jacobian + forcing
        return ca.horzcat(value, variation)

    # At the start ∂x/∂x = I and ∂x/∂u = 0.
    step = problem.sampling_time / model.time_unit / problem.substeps
    start = ca.horzcat(x, ca.SX.eye(n), ca.SX(n, m))
    end = runge_kutta(rate_and_variation, start, step, problem.substeps)
    x_next = end[:, 0]
    jacobian = end[:, 1:]
    return x_next, jacobian


@built_once
def stage_linearisation(problem: Problem, blocks: ThetaBlocks) -> ca.Function:
    """One stage's A_k, B_k and r_k of ξ₊ = A_k ξ + B_k v + r_k (paper.tex eq. param_nlp_qp).

    Args:
        problem: The problem with its model and scale.
        blocks: The blocks of θ.

    Returns:
        Function of x (n,) and u (m,) in the model's units and theta. Its results are A_kᵀ (n, n),
        B_kᵀ (m, n) and r_k (n,), which holds the model offset c_f too, for ξ and v in units of
        `Problem.scale`.
    """
    n = problem.n_states
    scale = problem.scale
    x, u, symbols = _linearisation_symbols(problem, blocks)
    x_s = ca.DM(problem.reference_state)
    u_s = ca.DM(problem.reference_action)

    # x₊ = f + A (x − x_k) + B (u − u_k) + c_f, in deviations from the reference.
    x_next, jacobian = _next_state(problem, symbols, x, u)
    A = jacobian[:, :n]
    B = jacobian[:, n:]
    from_state = A @ (x - x_s)
    from_action = B @ (u - u_s)
    offset = x_next - x_s - from_state - from_action
    offset = offset + symbols["c_f"]

    # In units of the scale; a derivative of ξ₊ by ξ has both the new and the old state's.
    per_state = 1 / scale.state
    state_units = np.outer(per_state, scale.state)
    action_units = np.outer(per_state, scale.action)
    A_scaled = A * ca.DM(state_units)
    B_scaled = B * ca.DM(action_units)
    # The transposes, since CasADi's memory is by columns and C's by rows.
    results = {
        "A": A_scaled.T,
        "B": B_scaled.T,
        "r": offset / ca.DM(scale.state),
    }
    arguments = {"x": x, "u": u, "theta": symbols["theta"]}
    return stage_function("linearise", arguments, results)


def stage_parameter_gradient(
    problem: Problem,
    blocks: ThetaBlocks,
    *,
    exact: bool,
) -> ca.Function:
    """One stage's ∇_p of the QP's Lagrangian in the model parameters p that θ holds.

    That is ∇_p [χᵀ(f + J Δw) + ⟨M, D⟩] with f and its Jacobian J at (x, u) and the step
    Δw = w − (x, u) to the QP's solution. With `exact`, D is the curvature of χ̄ᵀf under weights M.
    The multipliers are contracted before anything is differentiated, so that one tangent goes
    through the model in place of n + m.

    Args:
        problem: The problem with its model.
        blocks: The blocks of θ, one of which is p.
        exact: Whether the QP's Hessian holds the curvature of the model.

    Returns:
        Function of x (n,), u (m,), theta, w (n+m,) in the model's units, chi (n,) and, with
        `exact`, M (n+m, n+m) and guess (n,), which is χ̄; its result is `gradient` (n_p,).
    """
    n = problem.n_states
    m = problem.n_actions
    x, u, symbols = _linearisation_symbols(problem, blocks)
    theta = symbols["theta"]
    w = ca.SX.sym("w", n + m)
    chi = ca.SX.sym("chi", n)
    arguments = {
        "x": x,
        "u": u,
        "theta": theta,
        "w": w,
        "chi": chi,
    }

    # χᵀ(f + J Δw), whose J Δw is one tangent through the model.
    x_next, _ = _next_state(problem, symbols, x, u)
    point = ca.vertcat(x, u)
    tangent = ca.jtimes(x_next, point, w - point)
    lagrangian = ca.dot(chi, x_next + tangent)
    if has_prices(problem):
        change = _varying_cost(problem, symbols, x, u)
        lagrangian += change + ca.jtimes(change, point, w - point)
    if exact:
        M = ca.SX.sym("M", n + m, n + m)
        guess = ca.SX.sym("guess", n)
        D = _curvature(problem, symbols, x, u, guess)
        lagrangian += ca.dot(M, D)
        arguments["M"] = M
        arguments["guess"] = guess
    # By θ and not by p alone: p's symbols are entries of θ's.
    by_theta = ca.gradient(lagrangian, theta)
    by_parameters = by_theta[blocks.slices["p"]]
    return stage_function("parameter_gradient", arguments, {"gradient": by_parameters})


def _linearisation_symbols(
    problem: Problem,
    blocks: ThetaBlocks,
) -> tuple[ca.SX, ca.SX, Symbols]:
    """Symbols of a stage's state (n,) and action (m,), and those of θ."""
    x = ca.SX.sym("x", problem.n_states)
    u = ca.SX.sym("u", problem.n_actions)
    return x, u, symbolic_stage(problem, blocks)


def _next_state(
    problem: Problem,
    symbols: Symbols,
    x: ca.SX,
    u: ca.SX,
) -> tuple[ca.SX, ca.SX]:
    """`sampled_jacobian` at a stage, whose symbols are those of `symbolic_stage`."""
    return sampled_jacobian(problem, x, u, symbols["model_parameters"], symbols["disturbance"])


def has_prices(problem: Problem) -> bool:
    """Whether a price differs from stage to stage."""
    return bool(of_kind(problem.varying, "price"))


def _varying_cost(
    problem: Problem,
    symbols: Symbols,
    x: ca.SX,
    u: ca.SX,
) -> ca.SX:
    """γᵏ[ℓ(x, u, d_k, p_k) − ℓ(x, u, d_k, p̄_k)]: what the prices of a stage change of its cost.

    p̄_k is p_k with the prices at their nominal values, which θ's cost stands for.
    """
    cost = problem.model.economic_cost
    disturbance = symbols["disturbance"]
    present = cost(x, u, disturbance, symbols["model_parameters"])
    nominal = cost(x, u, disturbance, symbols["nominal_prices"])
    return symbols["discount"] * (present - nominal)


def _curvature(
    problem: Problem,
    symbols: Symbols,
    x: ca.SX,
    u: ca.SX,
    chi: ca.SX,
) -> ca.SX:
    """D = ∇²_(x,u) χᵀf(x, u), (n+m, n+m), of the sampled model f, and of what prices change."""
    x_next, _ = _next_state(problem, symbols, x, u)
    contracted = ca.dot(chi, x_next)
    if has_prices(problem):
        contracted += _varying_cost(problem, symbols, x, u)
    hessian, _ = ca.hessian(contracted, ca.vertcat(x, u))
    return hessian


@built_once
def preparation_definition(problem: Problem, blocks: ThetaBlocks) -> Definition:
    """Linearise and condense: all of the QP that does not depend on the state s.

    All of the QP is in units of `Problem.scale`: states ξ, actions v and costs.
    With V = (v_0, …, v_{N−1}) the predicted states are Ξ = Γ V + Φ ξ_0 + g, and the cost is
    ½VᵀHV + (f + F ξ_0)ᵀV + const. for stage costs ½wᵀL_k w + q_kᵀw and terminal ½ξᵀL_N ξ + q_Nᵀξ.

    Two sweeps of N calls each make it, in O(N²) operations: the forward one carries the responses
    of ξ_k to every control, to ξ_0 and to the offsets, the backward one turns them into columns of
    the Hessian. Controls are ordered by age, v_{k−1} first, so that all stages are alike.

    Args:
        problem: The problem with its model and scale.
        blocks: The blocks of θ.

    Returns:
        Function of x (n, N) and u (m, N), the linearisation points; L (n+m, N(n+m)), q (n+m, N),
        L_N (n, n), q_N (n); theta. Its results are A, B, r by stage; H, Γ by rows; Φ, g, f, F.
    """
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    width = horizon * m
    shapes = {
        "x": (n, horizon),
        "u": (m, horizon),
        "L": (n + m, horizon * (n + m)),
        "q": (n + m, horizon),
        "L_N": (n, n),
        "q_N": (n, 1),
        "theta": (given_size(problem, blocks), 1),
    }
    arguments = matrix_symbols(shapes)
    theta = stage_columns(problem, blocks, arguments["theta"])
    linearise = stage_linearisation(problem, blocks).map(horizon)
    A, B, r = linearise(arguments["x"], arguments["u"], theta)
    A_k = ca.horzsplit(A, n)
    B_k = ca.horzsplit(B, n)
    r_k = ca.horzsplit(r)
    L_k = ca.horzsplit(arguments["L"], n + m)
    q_k = ca.horzsplit(arguments["q"])

    # Forward, from the state of stage 0.
    respond = _respond(n, m, horizon)
    responses = [_initial_response(n, width)]
    for dynamics in zip(A_k, B_k, r_k, strict=True):
        following = respond(*dynamics, responses[-1])
        responses.append(following)

    # Backward: the costates' responses, from those of the terminal cost's gradient on.
    differentiate = _differentiate(n, m, horizon)
    costate = arguments["L_N"] @ responses[horizon]
    to_offsets = costate[:, -1] + arguments["q_N"]
    costate = ca.horzcat(costate[:, :-1], to_offsets)
    rows: list[ca.MX] = []
    for k in reversed(range(horizon)):
        row, costate = differentiate(
            A_k[k],
            B_k[k],
            L_k[k],
            q_k[k],
            responses[k],
            costate,
        )
        rows.insert(0, row)

    # Columns behind those of the controls belong to ξ_0, the last one to the offsets.
    states = responses[1:]
    hessian = _gather(rows, _hessian_positions(n, m, horizon))
    gamma = _gather(states, _response_positions(n, m, horizon))
    Phi = [response[:, width:-1] for response in states]
    g = [response[:, -1] for response in states]
    F = [row[:, width:-1] for row in rows]
    f = [row[:, -1] for row in rows]
    results = {
        "A": A,
        "B": B,
        "r": r,
        "H": hessian,
        "Gamma": gamma.T,
        "Phi": ca.vertcat(*Phi).T,
        "g": ca.vertcat(*g),
        "f": ca.vertcat(*f),
        "F": ca.vertcat(*F).T,
    }
    return define("preparation", arguments, results)


def preparation(problem: Problem, blocks: ThetaBlocks) -> StackedFunction:
    """`preparation_definition` with a memory.

    Args:
        problem: The problem with its model and scale.
        blocks: The blocks of θ.

    Returns:
        The function. Behind its results its memory has room for the rest of the QP: the costates
        (N, n) of the linearisation point, the discounted slack weights w and W (Nn,), and the
        constant of the stage costs.
    """
    entries = problem.horizon * problem.n_states
    room = {
        "costates": entries,
        "w": entries,
        "W": entries,
        "constant": 1,
    }
    return StackedFunction(preparation_definition(problem, blocks), room=room)


def _initial_response(n: int, width: int) -> ca.MX:
    """Responses (n, width + n + 1) of ξ_0: to itself alone, not to controls nor to offsets."""
    response = np.zeros((n, width + n + 1))
    response[:, width:-1] = np.eye(n)
    # Dense, as those of the other stages are: CasADi would drop the zeros.
    dense = ca.Sparsity.dense(*response.shape)
    entries = response.reshape(-1, order="F")
    return ca.MX(ca.DM(dense, entries))


def _respond(n: int, m: int, horizon: int) -> ca.Function:
    """Responses (n, Nm + n + 1) of ξ_{k+1} from those of ξ_k: to each control, ξ_0 and offsets."""
    width = horizon * m
    shapes = {
        "A": (n, n),
        "B": (m, n),
        "r": (n, 1),
        "response": (n, width + n + 1),
    }
    symbols = scalar_symbols(shapes)
    A = symbols["A"]
    B = symbols["B"]

    following = A.T @ symbols["response"]
    following[:, -1] += symbols["r"]
    # Every control is one sample older; the oldest columns, of controls yet to come, are zero.
    to_controls = following[:, : width - m]
    to_others = following[:, width:]
    following = ca.horzcat(B.T, to_controls, to_others)
    return stage_function("respond", symbols, {"following": following})


def _differentiate(n: int, m: int, horizon: int) -> ca.Function:
    """Rows (m, Nm + n + 1) of the gradient in v_k and costates (n, Nm + n + 1) at stage k."""
    width = horizon * m
    shapes = {
        "A": (n, n),
        "B": (m, n),
        "L": (n + m, n + m),
        "q": (n + m, 1),
        "response": (n, width + n + 1),
        "costate": (n, width + n + 1),
    }
    symbols = scalar_symbols(shapes)
    A = symbols["A"]
    B = symbols["B"]
    response = symbols["response"]
    costate = symbols["costate"]
    L_x, L_v = ca.vertsplit(symbols["L"], [0, n, n + m])
    q_x, q_v = ca.vertsplit(symbols["q"], [0, n, n + m])
    L_xx = L_x[:, :n]
    L_vx = L_v[:, :n]
    L_vv = L_v[:, n:]

    # The costate of stage k+1 responds to v_k first, which is one control more than ξ_k does.
    to_own_control = costate[:, :m]
    to_others = costate[:, m:]
    older = width - m
    state = ca.horzcat(response[:, :older], response[:, width:])

    # Gradient in v_k: L_vx ξ_k + L_vv v_k + q_v + Bᵀ χ_{k+1}.
    row = L_vx @ state + B @ to_others
    row[:, -1] += q_v
    own = B @ to_own_control + L_vv

    # Costate of stage k: L_xx ξ_k + q_x + Aᵀ χ_{k+1}.
    previous = L_xx @ state + A @ to_others
    previous[:, -1] += q_x
    # ξ_k does not respond to v_k, the one control that is not older.
    to_controls = ca.horzcat(previous[:, :older], ca.SX(n, m))
    results = {
        "row": ca.horzcat(own, row),
        "previous": ca.horzcat(to_controls, previous[:, older:]),
    }
    return stage_function("differentiate", symbols, results)


Positions = NDArray[np.int64]
"""Places of a matrix's entries in a column of numbers."""


def _gather(stages: Sequence[ca.MX], positions: Positions) -> ca.MX:
    """Matrix of the entries at these positions of the stages side by side; −1 stands for zero."""
    source = ca.horzcat(*stages)
    extended = ca.vertcat(ca.vec(source), 0)
    zero_position = source.numel()
    index = np.where(positions < 0, zero_position, positions)
    # CasADi counts by columns.
    by_columns = index.reshape(-1, order="F")
    entries = extended[by_columns.tolist()]
    return ca.reshape(entries, *positions.shape)


def _hessian_positions(n: int, m: int, horizon: int) -> Positions:
    """Positions of H's entries, (Nm, Nm), in the rows of all stages; its upper triangle mirrors."""
    width = horizon * m
    first, second = np.indices((width, width))
    # The Hessian is symmetric: of a pair of controls the later one's row has the entry.
    later = np.maximum(first, second)
    earlier = np.minimum(first, second)
    stage, row = np.divmod(later, m)
    column = _control_columns(stage, earlier, n, m, horizon)
    return column * m + row


def _response_positions(n: int, m: int, horizon: int) -> Positions:
    """Positions of Γ's entries, (Nn, Nm), in the responses of ξ_1 … ξ_N; −1 above its diagonal."""
    state, control = np.indices((horizon * n, horizon * m))
    stage, row = np.divmod(state, n)
    column = _control_columns(stage, control, n, m, horizon)
    position = column * n + row
    # A state does not respond to controls after it.
    is_later = control // m > stage
    position[is_later] = -1
    return position


def _control_columns(
    stage: Positions,
    control: Positions,
    n: int,
    m: int,
    horizon: int,
) -> Positions:
    """Columns of controls 0 … Nm−1, which are by age, in the responses of stages side by side."""
    own_stage, entry = np.divmod(control, m)
    age = stage - own_stage
    columns_a_stage = horizon * m + n + 1
    column: Positions = stage * columns_a_stage + age * m + entry
    return column


@built_once
def embedding_definition(problem: Problem, blocks: ThetaBlocks) -> Definition:
    """Initial value embedding: the vectors of the QP that depend on the state s.

    Args:
        problem: The problem with its scale.
        blocks: The blocks of θ.

    Returns:
        Function of s (n) and theta in the model's units, and of `preparation`'s Φ, g, f and F. Its
        results are the gradient f (Nm,) and the lower and upper limits (Nn,) that the soft rows Γ V
        must respect, in `Problem.scale`'s units.
    """
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    shapes = {
        "s": (n, 1),
        "theta": (given_size(problem, blocks), 1),
        "Phi": (n, horizon * n),
        "g": (horizon * n, 1),
        "f": (horizon * m, 1),
        "F": (n, horizon * m),
    }
    arguments = matrix_symbols(shapes)
    x_s = ca.DM(problem.reference_state)
    xi = (arguments["s"] - x_s) / ca.DM(problem.scale.state)
    bounds = soft_bounds(problem, blocks, arguments["theta"])
    stages = _embed(n, m).map(horizon)
    f, lower, upper = stages(
        ca.repmat(xi, 1, horizon),
        arguments["Phi"],
        ca.reshape(arguments["g"], n, horizon),
        ca.reshape(arguments["f"], m, horizon),
        arguments["F"],
        ca.horzcat(*[bound["soft_lower"] for bound in bounds]),
        ca.horzcat(*[bound["soft_upper"] for bound in bounds]),
    )
    results = {
        "f": ca.vec(f),
        "lower": ca.vec(lower),
        "upper": ca.vec(upper),
    }
    return define("embedding", arguments, results)


def _embed(n: int, m: int) -> ca.Function:
    """The gradient in v_k (m,) and the limits (n,) of the rows of ξ_{k+1}, from ξ_0."""
    symbols = scalar_symbols(
        {
            "xi": (n, 1),
            "Phi": (n, n),
            "g": (n, 1),
            "f": (m, 1),
            "F": (n, m),
            "soft_lower": (n, 1),
            "soft_upper": (n, 1),
        }
    )
    xi = symbols["xi"]
    # What the state does with no control; the rows have room for the controls' part.
    free = symbols["Phi"].T @ xi + symbols["g"]
    results = {
        "gradient": symbols["f"] + symbols["F"].T @ xi,
        "lower": symbols["soft_lower"] - free,
        "upper": symbols["soft_upper"] - free,
    }
    return stage_function("embed", symbols, results)


def embedding(
    problem: Problem,
    blocks: ThetaBlocks,
    prepared: StackedFunction,
    read: StackedFunction,
) -> StackedFunction:
    """`embedding_definition` in the memory of the two other functions.

    Args:
        problem: The problem with its scale.
        blocks: The blocks of θ.
        prepared: `preparation`'s function, whose memory holds theta, Φ, g, f and F.
        read: `readout`'s function, in whose memory are the state s and room for the results.

    Returns:
        The function, which writes to the read-out's memory.
    """
    # The three functions work in one memory: nothing is copied between them.
    shared = {
        "s": read.inputs["s"],
        "theta": prepared.inputs["theta"],
        "Phi": prepared.part("Phi"),
        "g": prepared.part("g"),
        "f": prepared.part("f"),
        "F": prepared.part("F"),
    }
    first = read.places["f"].start
    last = read.places["row_upper"].stop
    return StackedFunction(
        embedding_definition(problem, blocks),
        shared,
        memory=read.memory[first:last],
    )


@dataclass(frozen=True)
class Spectrum:
    """Eigenvalues (N, s) and eigenvectors (N, s, s) of the blocks before they were lifted.

    The blocks are those of steps `ranges` (s,) of (x, u), with costs relative to a level: their
    eigenvalues have no unit, and the lift is the same in every unit. `floor` (N, 1) is theirs.
    """

    values: Vector
    vectors: Vector
    floor: Vector
    ranges: Vector

    def undecided(self, tolerance: float = 1e-6) -> bool:
        """Whether an eigenvalue is so close to the floor that the lift has a kink there."""
        # At the floor itself the lift has a kink, and its derivative is one-sided.
        distance = np.abs(self.values - self.floor)
        size = np.abs(self.values)
        size = np.maximum(1.0, size)
        at_floor = distance < tolerance * size
        return bool(at_floor.any())

    def contract(self, seed: Vector) -> Vector:
        """Adjoint of the derivative of L = P(·): M with ⟨seed, dL⟩ = ⟨M, dX⟩, shapes (N, s, s).

        L, X and the seed are in the model's units. The derivative of a spectral function is a
        Schur product with its divided differences in the eigenbasis (Daleckii and Krein).
        """
        divided = self._divided_differences()
        # Seed and result are in the model's units, the eigenvectors in those of `ranges`.
        metric = np.outer(self.ranges, self.ranges)
        vectors = self.vectors
        transposed = vectors.transpose(0, 2, 1)
        scaled_seed = seed / metric
        in_eigenbasis = transposed @ scaled_seed @ vectors
        product = divided * in_eigenbasis
        scaled_result = vectors @ product @ transposed
        return np.asarray(scaled_result * metric)

    def _divided_differences(self) -> Vector:
        """(P(a) − P(b)) / (a − b) of a block's eigenvalues (N, s, s), or P' where a is b."""
        values = self.values
        lifted = np.maximum(values, self.floor)
        derivative = (values > self.floor).astype(float)

        a, b = _all_pairs(values)
        lifted_a, lifted_b = _all_pairs(lifted)
        derivative_a, derivative_b = _all_pairs(derivative)
        gap = a - b
        rise = lifted_a - lifted_b
        largest = np.abs(values).max()
        same = np.abs(gap) < 1e-12 * max(1.0, largest)
        # No division where the result is not used.
        divisor = np.where(same, 1, gap)
        return np.where(same, derivative_a * derivative_b, rise / divisor)


def _all_pairs(values: Vector) -> tuple[Vector, Vector]:
    """First (N, s, 1) and second (N, 1, s) members of all pairs of entries in rows (N, s)."""
    first = values[:, :, None]
    second = values[:, None, :]
    return first, second


class GaussNewton:
    """L_k = 2γᵏB_l, the Hessian of the cost: the QP then holds the paper's cost as it is.

    It fills the QP's stage costs ½wᵀL_k w + q_kᵀw in the memory of the preparation, in units of
    `Problem.scale`; `functions` are the CasADi functions that it calls, by the prefix of their
    constants in C, `spectrum` that of the last blocks if they were lifted. `bend` (n+m, n+m) and
    `slope` (n+m,) bring a cost's second and first derivatives from the model's units to the QP's.
    """

    source = "gauss_newton.h"
    """The rule in C."""
    lifts = False
    spectrum: Spectrum | None = None

    def __init__(
        self,
        problem: Problem,
        blocks: ThetaBlocks,
        prepared: StackedFunction,
    ) -> None:
        horizon = problem.horizon
        width = problem.n_states + problem.n_actions
        n = problem.n_states
        self.functions: dict[str, StackedFunction] = {}
        scale = problem.scale
        # A derivative by scaled variables has their scales as factors.
        self.bend = np.outer(scale.both, scale.both) / scale.cost
        self.slope = scale.both / scale.cost
        self._state_bend = self.bend[:n, :n]
        self._state_slope = self.slope[:n]
        # γᵏ of the stages, as columns; and γᴺ.
        self.discounts = problem.discounts[:-1, None]
        self.end_discount = float(problem.discounts[-1])
        # Views of the preparation's memory: what is written to them is in the QP.
        inputs = prepared.inputs
        self._signal_costs: StackedFunction | None = None
        if has_prices(problem) or of_kind(problem.varying, "reference"):
            shared = {"theta": inputs["theta"]}
            self._signal_costs = StackedFunction(signal_costs(problem, blocks), shared)
            self.functions["SIGNAL"] = self._signal_costs
        self.L = inputs["L"].reshape(horizon, width, width)
        self.q = inputs["q"].reshape(horizon, width)
        self._L_N = inputs["L_N"].reshape(n, n)
        self._q_N = inputs["q_N"]

    def set_parameters(self, parameters: Parameters) -> None:
        """Take over a new θ: its costs, which no linearisation point changes here."""
        discounts = self.discounts
        end_discount = self.end_discount
        self.L[:] = self.cost_hessians(parameters["B_l"]) * self.bend
        self.q[:] = discounts * parameters["b_l"] * self.slope

        terminal_hessian = 2 * end_discount * parameters["B_Vf"]
        terminal_gradient = end_discount * parameters["b_Vf"]
        self._L_N[:] = terminal_hessian * self._state_bend
        self._q_N[:] = terminal_gradient * self._state_slope
        # Of θ alone: what signals change of it is added at each linearisation.
        self._q_of_theta = self.q.copy()
        self._q_N_of_theta = self._q_N.copy()

    def cost_hessians(self, B: Matrix) -> Vector:
        """Hessians 2γᵏB of the stages' costs γᵏwᵀB w, (N, n+m, n+m), in the model's units."""
        weights = 2 * self.discounts
        return weights[:, :, None] * B

    def fill(self, x: Vector, u: Vector, costates: Vector) -> float:
        """Write L and q for a point of linearisation.

        Args:
            x: Its states x_0 … x_{N−1}, (N, n).
            u: Its actions, (N, m).
            costates: Its costates χ̄_1 … χ̄_N, (N, n).

        Returns:
            The constant of the stage costs, in the model's unit of cost.
        """
        if self._signal_costs is None:
            return 0.0
        self.q[:] = self._q_of_theta
        return self._add_signal_costs(self._signal_costs, x, u)

    def _add_signal_costs(self, costs: StackedFunction, x: Vector, u: Vector) -> float:
        """Add what signals change of q and q_N; returns what they change of the constant."""
        costs.inputs["x"][:] = x.reshape(-1)
        costs.inputs["u"][:] = u.reshape(-1)
        costs()
        self.q += costs.part("q").reshape(self.q.shape)
        self._q_N[:] = self._q_N_of_theta + costs.part("q_N")
        return float(costs.part("constant")[0])


class Exact(GaussNewton):
    """L_k = P(2γᵏB_l + D_k), D_k the curvature of χ̄_{k+1}ᵀf at the linearisation point.

    P lifts the eigenvalues of each stage's block to at least γᵏ·`FLOOR`, so that the QP keeps its
    stage structure and is strictly convex. They are those of the block over the ranges of (x, u)
    and relative to the level of the cost in `Problem.scale`, so P is the same in every unit. The
    floor does not depend on θ, so that P can be differentiated. The terminal cost has no curvature
    of the model and stays as it is. Where `lifts` is false P is the identity, and the QP may be
    indefinite.
    """

    source = "exact.h"
    FLOOR = 1e-3

    def __init__(
        self,
        problem: Problem,
        blocks: ThetaBlocks,
        prepared: StackedFunction,
    ) -> None:
        super().__init__(problem, blocks, prepared)
        self.lifts = True
        self._reference = problem.reference
        self._ranges = problem.scale.ranges
        # Over the ranges, and relative to the level of the cost, eigenvalues have no unit.
        self.metric = np.outer(self._ranges, self._ranges) / problem.scale.level
        # It reads (θ, σ) where the preparation does.
        shared = {"theta": prepared.inputs["theta"]}
        self._curvature = StackedFunction(_curvature_by_stage(problem, blocks), shared)
        self.functions["CURVATURE"] = self._curvature

    def set_parameters(self, parameters: Parameters) -> None:
        """Take over the costs of θ."""
        super().set_parameters(parameters)
        self._B = parameters["B_l"]
        self._b = parameters["b_l"]

    def fill(self, x: Vector, u: Vector, costates: Vector) -> float:
        """Write the convexified blocks and the gradients that go with them; see `GaussNewton`."""
        blocks = self.cost_hessians(self._B) + self._curvatures(x, u, costates)
        if not np.isfinite(blocks).all():
            # The controller refuses the QP; an eigenvalue solver would raise its own error.
            self.L[:] = np.nan
            return np.nan

        self.spectrum = None
        if self.lifts:
            blocks += self._lift(blocks)

        # The cost is expanded about the point of linearisation: its gradient there is that of ℓ_θ,
        # and the QP's variables are deviations from the reference.
        point = np.concatenate([x, u], axis=1)
        point -= self._reference
        by_blocks = np.einsum("kij,kj->ki", blocks, point)
        by_cost = 2 * self.discounts * (point @ self._B)
        gradient = by_cost + self.discounts * self._b - by_blocks
        self.L[:] = blocks * self.bend
        self.q[:] = gradient * self.slope
        # What is left of the expansion at the reference: ½ pᵀ(L_k − 2γᵏB_l) p of each stage.
        products = point * (by_blocks - by_cost)
        constant = float(products.sum() / 2)
        if self._signal_costs is not None:
            constant += self._add_signal_costs(self._signal_costs, x, u)
        return constant

    def _curvatures(self, x: Matrix, u: Matrix, costates: Matrix) -> Vector:
        """Curvature D_k (N, n+m, n+m) of the dynamics along χ̄, at the point given to `fill`."""
        curvature = self._curvature
        inputs = curvature.inputs
        inputs["x"][:] = x.reshape(-1)
        inputs["u"][:] = u.reshape(-1)
        inputs["guess"][:] = costates.reshape(-1)
        curvature()
        return curvature.part("D").reshape(self.L.shape)

    def _lift(self, blocks: Vector) -> Vector:
        """Lift of the eigenvalues of blocks (N, n+m, n+m) to the floor; keeps their spectrum."""
        values, vectors = np.linalg.eigh(blocks * self.metric)
        floor = self.FLOOR * self.discounts
        self.spectrum = Spectrum(values, vectors, floor, self._ranges)
        # What is to be lifted is added: what is above the floor keeps its digits.
        rise = np.maximum(floor - values, 0.0)
        raised_vectors = vectors * rise[:, None, :]
        transposed = vectors.transpose(0, 2, 1)
        lift = raised_vectors @ transposed
        return np.asarray(lift / self.metric)


@built_once
def _curvature_by_stage(problem: Problem, blocks: ThetaBlocks) -> Definition:
    """D_k (n+m, n+m) of all stages from x (n, N), u (m, N), guess (n, N), which is χ̄, and theta."""
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    x, u, symbols = _linearisation_symbols(problem, blocks)
    chi = ca.SX.sym("chi", n)
    D_k = _curvature(problem, symbols, x, u, chi)
    stage = stage_function(
        "curvature_of_stage",
        {"x": x, "u": u, "chi": chi, "theta": symbols["theta"]},
        {"D": D_k},
    )
    shapes = {
        "x": (n, horizon),
        "u": (m, horizon),
        "guess": (n, horizon),
        "theta": (given_size(problem, blocks), 1),
    }
    arguments = matrix_symbols(shapes)
    theta = stage_columns(problem, blocks, arguments["theta"])
    # Mapped, so that its C is a loop over the stages.
    stages = stage.map(horizon)
    D = stages(
        arguments["x"],
        arguments["u"],
        arguments["guess"],
        theta,
    )
    return define("curvature", arguments, {"D": D})


@built_once
def signal_costs(problem: Problem, blocks: ThetaBlocks) -> Definition:
    """Change by signals of the linear terms of the QP's costs, and of their constant.

    A reference that moves by Δ_k makes the cost ℓ_θ(w − Δ_k). What prices change of the economic
    cost is linearised at (x_k, u_k); the exact Hessian has its curvature.

    Args:
        problem: The problem with its model and scale.
        blocks: The blocks of θ.

    Returns:
        Function of x (n, N), u (m, N) and (θ, σ). Its results are q (n+m, N) and q_N (n,), in
        units of `Problem.scale`, and `constant`, in the model's unit of cost.
    """
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    scale = problem.scale
    symbols = symbolic_given(problem, blocks)
    points = scalar_symbols({"x": (n, horizon), "u": (m, horizon)})
    references = moved_references(problem, symbols["sigma"])
    x, u, at_stage = _linearisation_symbols(problem, blocks)
    cost = _varying_cost(problem, at_stage, x, u)
    slope = ca.gradient(cost, ca.vertcat(x, u))
    expand = ca.Function("priced", [x, u, at_stage["theta"]], [cost, slope])

    constant = ca.SX(0.0)
    gradients = []
    discounts = problem.discounts.tolist()
    theta = symbols["theta"][: blocks.size]
    for k in range(horizon):
        point = ca.vertcat(points["x"][:, k], points["u"][:, k])
        given = ca.vertcat(theta, symbols["sigma"][:, k], discounts[k])
        value, gradient = expand(point[:n], point[n:], given)
        # The QP's variables are deviations from the reference: the constant is the value there.
        constant += value - ca.dot(gradient, point - problem.reference)
        moved, offset = _moved_cost(symbols["B_l"], symbols["b_l"], references[k])
        gradients.append(gradient + discounts[k] * moved)
        constant += discounts[k] * offset
    moved, offset = _moved_cost(symbols["B_Vf"], symbols["b_Vf"], references[horizon][:n])
    constant += discounts[horizon] * offset
    results = {
        "q": ca.horzcat(*gradients) * ca.repmat(ca.DM(scale.both / scale.cost), 1, horizon),
        "q_N": discounts[horizon] * moved * ca.DM(scale.state / scale.cost),
        "constant": constant,
    }
    return define("signal_costs", {**points, "theta": symbols["theta"]}, results)


def _moved_cost(B: ca.SX, b: ca.SX, by: ca.SX) -> tuple[ca.SX, ca.SX]:
    """Gradient and constant that (w − Δ)ᵀB(w − Δ) + bᵀ(w − Δ) has more than wᵀBw + bᵀw."""
    gradient = -2 * B @ by
    constant = ca.bilin(B, by) - ca.dot(b, by)
    return gradient, constant


HESSIANS = {"gauss-newton": GaussNewton, "exact": Exact}


@built_once
def integration_of(problem: Problem) -> Integration:
    """How far a sample's prediction is off, at the problem's reference and its bounds."""
    return measure_integration(
        problem.model,
        problem.sampling_time,
        problem.substeps,
        problem.reference,
        problem.lower,
        problem.upper,
    )


def check_integration(problem: Problem) -> Integration:
    """Refuse a prediction that is unstable where the model is not; warn where it is coarse.

    Raises ModelError at a mode that decays in the model and grows in the prediction.
    """
    model = problem.model
    integration = integration_of(problem)
    if integration.unstable:
        raise ModelError(
            f"model '{model.name}' is too stiff for substeps = {problem.substeps}: at the "
            "reference the prediction of a stable mode grows in a sample of "
            f"{problem.sampling_time:g} s; {integration.remedy}"
        )
    if integration.coarse:
        where = "at the reference" if integration.at_reference else "at the bounds"
        # Of a prediction that runs away a number says nothing.
        size = "many times"
        if integration.error < 10:
            size = f"{100 * integration.error:.0f} % of"
        warn(
            f"model '{model.name}' is integrated coarsely by substeps = {problem.substeps}: "
            f"{where} a prediction over {problem.sampling_time:g} s is off by {size} the range of "
            f"{integration.state}; {integration.remedy}",
            ModelWarning,
        )
    return integration


class SampleFunctions:
    """The CasADi functions that make a sample's QP and read its solution out.

    `preparation` and `embedding` make the QP with the rule `hessian`, `readout` takes its value.
    The memory of the first and the last hold a sample's QP and its solution. Raises ControllerError
    on an unknown Hessian, ModelError where the model is too stiff for the problem's substeps.
    """

    def __init__(self, problem: Problem, blocks: ThetaBlocks, hessian: str) -> None:
        if hessian not in HESSIANS:
            raise ControllerError(f"there is no Hessian '{hessian}'{instead(hessian, HESSIANS)}")
        # First of all, since a model that is too stiff makes no controller.
        self.integration = check_integration(problem)
        self.problem = problem
        self.blocks = blocks
        self.preparation = preparation(problem, blocks)
        # The read-out and the embedding read what the preparation writes.
        self.readout = readout(problem, blocks, self.preparation)
        self.embedding = embedding(problem, blocks, self.preparation, self.readout)
        self.hessian = HESSIANS[hessian](problem, blocks, self.preparation)

    @cached_property
    def stage(self) -> ca.Function:
        """The linearisation of one stage, which C calls for each."""
        return stage_linearisation(self.problem, self.blocks)

    @property
    def named(self) -> dict[str, StackedFunction]:
        """The functions by the prefix of their constants in C."""
        functions = {
            "PREPARED": self.preparation,
            "EMBEDDED": self.embedding,
            "READ": self.readout,
        }
        return functions | self.hessian.functions

    def qp(self, before: Vector, after: Vector) -> SoftQp:
        """The QP in the memory of preparation and read-out, or in copies of it.

        Args:
            before: Memory of `preparation`, or a copy.
            after: Memory of `readout`, or a copy.

        Returns:
            A QP of views: what is written to the memory changes it.
        """
        prepared = self.preparation
        read = self.readout
        return SoftQp(
            H=prepared.matrix("H", before),
            f=read.part("f", after),
            lower=read.part("lower", after),
            upper=read.part("upper", after),
            rows=prepared.matrix("Gamma", before),
            row_lower=read.part("row_lower", after),
            row_upper=read.part("row_upper", after),
            w=prepared.part("w", before),
            W=prepared.part("W", before),
        )
