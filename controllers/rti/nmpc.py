"""Real-time-iteration NMPC: one QP a sample, prepared before the state is known; its solution."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.errors import ControllerError, ModelWarning, ParameterError, QpError
from controllers.export.core import (
    ENGINE_SOURCES,
    STATUSES,
    controller_sources,
    why_not_in_c,
)
from controllers.functions import (
    COMPILED,
    INTERPRETED,
    LONG,
    StackedFunction,
    consecutive,
    library,
    worth_compiling,
)
from controllers.preparation import SOLVED_RESIDUAL, Exact, SampleFunctions, Spectrum
from controllers.problem import Problem, hold_last, linear_model
from controllers.qp import (
    QpBackend,
    QpSolution,
    SoftQp,
    make_backend,
    multipliers_at_kink,
    polish,
)
from controllers.sensitivities import (
    SOLUTION_PARTS,
    adjoint_directions,
    curvature_directions,
    sensitivities,
)
from controllers.stabilised import Stages, solve_stabilised
from controllers.theta import Parameters, nominal_given
from cosim.core.errors import warn
from cosim.core.protocols import CompiledLoop, Matrix, Vector
from cosim.core.scenario import Scenario


class LinearisationPoint(NamedTuple):
    """Linearisation point of a QP: states x (N, n), actions u (N, m), costates (N, n).

    The state at stage N is not needed since the terminal cost is quadratic; the costates χ_1 … χ_N
    matter for the exact Hessian only.
    """

    x: Matrix
    u: Matrix
    costates: Matrix


class NmpcFunctions(SampleFunctions):
    """The CasADi functions of a controller: a sample's, and its derivatives in θ."""

    @cached_property
    def derivatives(self) -> tuple[StackedFunction, Callable[[], StackedFunction]]:
        """The value's gradient and a maker of the policy's derivatives, on first use."""
        exact = isinstance(self.hessian, Exact)
        return sensitivities(self.problem, self.blocks, exact=exact)

    @property
    def named(self) -> dict[str, StackedFunction]:
        """The functions by the prefix of their constants in C."""
        gradient, make_policy = self.derivatives
        derivatives = {
            "GRADIENT": gradient,
            "POLICY": make_policy(),
        }
        return super().named | derivatives

    def condense(self, before: Vector, after: Vector) -> None:
        """Write the condensed QP into copies of both memories.

        Args:
            before: Copy of the preparation's memory, whose inputs are a point and θ.
            after: Copy of the read-out's memory, which has the state.
        """
        prepared = self.preparation.memory
        read = self.readout.memory
        # The functions have one memory, which holds the present sample: lend it and put it back.
        saved = prepared.copy(), read.copy()
        prepared[:] = before
        read[:] = after
        self.preparation()
        self.embedding()
        before[:] = prepared
        after[:] = read
        prepared[:], read[:] = saved


@dataclass(eq=False)
class Prepared:
    """Data of a preparation phase, kept for read-outs after the next one has begun.

    `memory` is a copy of the preparation's memory. `spectrum` is that of the exact Hessian's blocks
    before the lift that made them convex. `functions` and `engine` are the controller's. An engine
    that solves stage by stage condenses the QP only when it is asked for.
    """

    memory: Vector
    spectrum: Spectrum | None
    functions: NmpcFunctions
    engine: Engine | None = None

    def part(self, name: str) -> Vector:
        """An input, result or other part of the preparation's memory, flat."""
        return self.functions.preparation.part(name, self.memory)

    @cached_property
    def point(self) -> LinearisationPoint:
        """Linearisation point of the QP."""
        horizon = self.functions.problem.horizon

        def stages(name: str) -> Matrix:
            return self.part(name).reshape(horizon, -1).copy()

        return LinearisationPoint(
            x=stages("x"),
            u=stages("u"),
            costates=stages("costates"),
        )

    def contract(self, seed: Vector) -> Vector:
        """Adjoint of the lift's derivative (`Spectrum.contract`), of the identity without one."""
        if self.spectrum is None:
            return seed
        return self.spectrum.contract(seed)


@dataclass(eq=False)
class RtiSolution:
    """The solution of one QP, read as V(s) and π(s), or as Q(s, a) where u_0 = a was enforced.

    `action` (m,) is u_0; `value` is V or Q; `enforced` says which; `status` is `solved`. All
    derivatives are those of the QP that was solved, at the point where it was linearised
    (paper.tex, RTI Sensitivities); they are one-sided where `weakly_active`, and computed when they
    are asked for from `prepared` and a copy of the read-out's `memory`.
    """

    action: Vector
    value: float
    prepared: Prepared = field(repr=False)
    memory: Vector = field(repr=False)
    enforced: bool = False
    status: str = "solved"

    def _part(self, name: str) -> Vector:
        return self.prepared.functions.readout.part(name, self.memory)

    def _by_stage(self, name: str) -> Matrix:
        return self.prepared.functions.readout.matrix(name, self.memory)

    @cached_property
    def multipliers(self) -> QpSolution:
        """Primal-dual solution of the condensed QP, in units of `Problem.scale`."""
        return QpSolution(
            v=self._part("v"),
            nu=self._part("nu"),
            lam=self._part("lam"),
        )

    @cached_property
    def qp(self) -> SoftQp:
        """The condensed QP that was solved, in units of `Problem.scale`."""
        prepared = self.prepared
        functions = prepared.functions
        if prepared.engine is not None and prepared.engine.stagewise:
            functions.condense(prepared.memory, self.memory)
        return functions.qp(prepared.memory, self.memory)

    @cached_property
    def predicted_states(self) -> Matrix:
        """Predicted states x_0 … x_N, shape (N+1, n)."""
        reference = self.prepared.functions.problem.reference_state
        return self._by_stage("xi") + reference

    @cached_property
    def predicted_actions(self) -> Matrix:
        """Predicted actions u_0 … u_{N−1}, shape (N, m)."""
        problem = self.prepared.functions.problem
        scaled = self.multipliers.v.reshape(-1, problem.n_actions)
        deviation = scaled * problem.scale.action
        return np.asarray(deviation + problem.reference_action)

    @property
    def unshifted(self) -> LinearisationPoint:
        """The solution, not shifted, as a point of linearisation for the same sample."""
        return LinearisationPoint(
            x=self.predicted_states[:-1],
            u=self.predicted_actions,
            costates=self.costates[1:],
        )

    @property
    def slack(self) -> Matrix:
        """Slack of the soft state bounds at stages 1 … N, shape (N, n)."""
        return self._by_stage("t")

    @property
    def costates(self) -> Matrix:
        """Multipliers χ_0 … χ_N of the initial value and the dynamics, shape (N+1, n).

        χ_0 is dV/ds or dQ/ds. At a true bound the penalty of s itself has a kink, and half of its
        slope is taken.
        """
        return self._by_stage("chi")

    @property
    def action_gradient(self) -> Vector:
        """dQ/da, shape (m,): zero where the action was not enforced."""
        m = self.action.size
        if not self.enforced:
            return np.zeros(m)
        price = self.prepared.functions.problem.scale.action_price
        # ν of the equation u_0 = a.
        equation_nu = self.multipliers.nu[:m]
        return np.asarray(-equation_nu * price)

    @property
    def residual(self) -> float:
        """Largest KKT residual, without a unit: see `readout`. `solved` was said after a look."""
        return float(self._part("residual")[0])

    @property
    def iterations(self) -> int | None:
        """Steps of the compiled QP solver; None where another one solved."""
        if self.prepared.engine is None:
            return None
        return int(self._part("iterations")[0])

    @cached_property
    def weakly_active(self) -> bool:
        """Whether a limit is about to change its activity, so that derivatives are one-sided.

        The same holds where an eigenvalue of the exact Hessian is about to be lifted.
        """
        spectrum = self.prepared.spectrum
        lifting = spectrum is not None and spectrum.undecided()
        return lifting or self.multipliers.weakly_active(self.qp)

    @cached_property
    def licq(self) -> bool:
        """Whether the active constraints' gradients are linearly independent."""
        return self.multipliers.licq_margin(self.qp) > 1e-9

    @cached_property
    def value_gradient(self) -> Vector:
        """dV/dθ or dQ/dθ, shape (n_θ,): ∇θ of the QP's Lagrangian at the solution."""
        if self.prepared.engine is not None:
            return self._part("gradient")
        function, _ = self.prepared.functions.derivatives
        self._write_solution(function)
        function()
        return function.stack.copy()

    @property
    def policy_jacobian(self) -> Matrix:
        """dπ/dθ, shape (m, n_θ); raises ControllerError where the action was enforced."""
        return self._policy[0]

    @property
    def policy_state_jacobian(self) -> Matrix:
        """dπ/ds, shape (m, n); raises ControllerError where the action was enforced."""
        return self._policy[1]

    @cached_property
    def _policy(self) -> tuple[Matrix, Matrix]:
        if self.enforced:
            raise ControllerError(
                "the action was enforced, so this solution is Q(s, a) and has no policy; "
                "call feedback(s) without an action"
            )
        m = self.action.size
        prepared = self.prepared
        if prepared.engine is not None:
            # Compiled code factorises the KKT matrix, which is singular where LICQ fails.
            jacobians = prepared.engine.policy(prepared.memory, self.memory)
            if jacobians is not None:
                return jacobians

        # By Python, which solves the KKT system by least squares where LICQ fails.
        _, make_function = prepared.functions.derivatives
        function = make_function()
        self._write_solution(function)
        self._write_directions(function)
        function()
        by_theta = function.part("policy").reshape(m, -1)
        by_state = function.part("state").reshape(m, -1)
        return by_theta.copy(), by_state.copy()

    def _write_directions(self, function: StackedFunction) -> None:
        """Write the adjoint directions into the inputs of the policy's derivatives."""
        inputs = function.inputs
        dv, dt, dlam = adjoint_directions(self.qp, self.multipliers, self.action.size)
        inputs["dv"][:] = dv.reshape(-1)
        inputs["dt"][:] = dt.reshape(-1)
        inputs["dlam"][:] = dlam.reshape(-1)
        if "dM" in inputs:
            dM = curvature_directions(
                self.qp.rows,
                dv,
                self._step_from_point(),
                self.prepared.contract,
                self.prepared.functions.problem.scale,
            )
            inputs["dM"][:] = dM.reshape(-1)

    def _write_solution(self, function: StackedFunction) -> None:
        """Write this solution and its QP into the inputs of a function of `sensitivities`."""
        inputs = function.inputs
        prepared = self.prepared
        for name in SOLUTION_PARTS:
            inputs[name][:] = self._part(name)
        # The value's gradient needs the first three alone, the policy's derivatives all.
        for name in inputs.keys() & {"x", "u", "theta", "A", "B", "L", "L_N"}:
            inputs[name][:] = prepared.part(name)
        if "M" in inputs:
            # The second-order term is ½ΔwᵀLΔw: its derivative by L, pulled back through the lift.
            step = self._step_from_point()
            outer = step[:, :, None] * step[:, None, :]
            M = prepared.contract(outer / 2)
            inputs["M"][:] = M.reshape(-1)
            inputs["guess"][:] = prepared.part("costates")

    def _step_from_point(self) -> Matrix:
        """Δw of each stage, shape (N, n+m)."""
        point = self.prepared.point
        states = self.predicted_states[:-1] - point.x
        actions = self.predicted_actions - point.u
        return np.concatenate([states, actions], axis=1)


class BatchSolution(NamedTuple):
    """Solutions of K QPs, a row each; π and V of a row are NaN where its QP is not solved.

    `action` (K, m) is π, or the action that was enforced; `value` (K,) is V, or Q. Derivatives are
    None where they were not asked for, and zero where a row has none: `state_gradient` (K, n) is
    dV/ds, `value_gradient` (K, n_θ) dV/dθ, `action_gradient` (K, m) dQ/da, `policy_jacobian`
    (K, m, n_θ) dπ/dθ and `policy_state_jacobian` (K, m, n) dπ/ds.
    """

    action: Vector
    value: Vector
    state_gradient: Vector | None = None
    value_gradient: Vector | None = None
    action_gradient: Vector | None = None
    policy_jacobian: Vector | None = None
    policy_state_jacobian: Vector | None = None


class _Batch:
    """The arrays of a batch of K QPs: what is given, and what C and Python write row by row.

    Shapes are `states` (K, n), `enforced` (K, m) or None, `theta` (K, n_θ), `points` of
    linearisation with K rows, `actions` (K, m) and `values` (K,). `slopes` has a row's derivatives
    side by side, as `engine_batch` writes them; None where they are not asked for.
    """

    def __init__(
        self,
        states: Vector,
        enforced: Vector | None,
        theta: Vector,
        points: LinearisationPoint,
        *,
        derivatives: bool,
    ) -> None:
        count, n = states.shape
        m = points.u.shape[-1]
        size = theta.shape[-1]
        self.states = states
        self.enforced = enforced
        self.theta = theta
        self.points = points
        # A row that stays NaN has no solution.
        self.actions = np.full((count, m), np.nan)
        self.values = np.full(count, np.nan)
        self.slopes: Vector | None = None
        if derivatives:
            of_value = n + size + m
            of_policy = m * (size + n)
            self.slopes = np.zeros((count, of_value + of_policy))

    def point(self, k: int) -> LinearisationPoint:
        """The point of linearisation of row k."""
        x, u, costates = self.points
        return LinearisationPoint(x[k], u[k], costates[k])

    def write(self, k: int, solution: RtiSolution) -> None:
        """Write a solution into row k."""
        self.actions[k] = solution.action
        self.values[k] = solution.value
        if self.slopes is None:
            return
        parts = [
            solution.costates[0],
            solution.value_gradient,
            solution.action_gradient,
        ]
        if not solution.enforced:
            parts.append(solution.policy_jacobian.ravel())
            parts.append(solution.policy_state_jacobian.ravel())
        # An enforced action has no policy: the end of its row stays zero.
        row = np.concatenate(parts)
        self.slopes[k, : row.size] = row

    def solution(self) -> BatchSolution:
        """The batch as it is returned to the user."""
        if self.slopes is None:
            return BatchSolution(self.actions, self.values)
        n = self.states.shape[1]
        m = self.actions.shape[1]
        size = self.theta.shape[1]
        # As `engine_batch` lays a row's derivatives out.
        places = consecutive(
            {
                "state_gradient": n,
                "value_gradient": size,
                "action_gradient": m,
                "policy_jacobian": m * size,
                "policy_state_jacobian": m * n,
            }
        )
        parts = {name: self.slopes[:, place] for name, place in places.items()}
        parts["policy_jacobian"] = parts["policy_jacobian"].reshape(-1, m, size)
        parts["policy_state_jacobian"] = parts["policy_state_jacobian"].reshape(-1, m, n)
        return BatchSolution(self.actions, self.values, **parts)


NOT_FINITE = STATUSES.index("not finite")
INACCURATE = "inaccurate"
"""Status of the QpError of a QP whose solution is not accurate enough to be used."""
ACCURATE_RESIDUAL = 1e-9
"""KKT residual above which a solution is polished."""
GROWTH_LIMIT = 100.0
"""Growth over the horizon above which the QP is not condensed.

It is that at the reference; where a closed loop goes it may be a thousand times as large, and the
condensed QP then loses all digits.
"""


def growth_over_horizon(problem: Problem) -> float:
    """Growth of the fastest mode of the nominal model at its reference over the horizon, ρ(A)ᴺ.

    The condensed Hessian has the square of this in its condition number.
    """
    A, _ = linear_model(problem)
    radius = np.abs(np.linalg.eigvals(A)).max()
    return float(radius**problem.horizon)


CROSSING = 30
"""Stages from which a sweep by stages is faster, with one action and no more states."""
CONDENSING_LIMIT = 800_000
"""Bytes of the stack that the engine's condensing may take: a thread of Python's has a megabyte.

The QP itself and the solver's work are in the engine's arrays, not on the stack.
"""


def solves_by_stage(problem: Problem) -> bool:
    """Whether a compiled engine solves the QP stage by stage and does not condense it.

    Condensing and the factor take (N m)³ operations, a sweep by stages N n³: they cross at an N
    that grows as (n/m)^1.5, and falls with m as the solver by stages then takes fewer sweeps. Where
    that is was measured on tanks in series, one level at its bound (`python -m benchmarks.paths`,
    benchmarks/performance.md). Where the model is unstable the condensed QP would lose its digits.

    Args:
        problem: The control problem, whose QP has N stages of n states and m actions.
    """
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    crossing = CROSSING * max(1.0, n / m) ** 1.5 / m ** (2 / 3)
    long = horizon >= crossing
    # Responses of each stage's state to all controls, and the factor of the condensed Hessian.
    controls = horizon * m
    responses = (horizon + 1) * n * (controls + n + 1)
    factor = controls * (controls + 1)
    large = 8 * (responses + factor) > CONDENSING_LIMIT
    return long or large or growth_over_horizon(problem) > GROWTH_LIMIT


class Engine:
    """Prepares and solves in the memory of a controller's `functions`; `compile` makes one.

    `prepare` and `feedback` return 0, or a status of the QP solver's (`STATUSES`). `action` (m,) is
    where the action to enforce is written. `stagewise` says whether the QP is solved stage by stage
    and not condensed.
    """

    def __init__(self, path: str, functions: NmpcFunctions, stagewise: bool) -> None:
        self.stagewise = stagewise
        self._library = ctypes.CDLL(path)
        # ctypes takes every result for an int, which is too short for these.
        self._library.engine_sizes.restype = ctypes.c_size_t
        self._library.engine_loop_size.restype = ctypes.c_size_t
        self._library.engine_run.restype = ctypes.c_longlong

        self._before = functions.preparation.memory
        self._after = functions.readout.memory
        self.action: Vector = np.zeros(functions.problem.n_actions)
        # CasADi's functions and the C structs share this memory: a size that differs would be a
        # wrong number, not a crash.
        message = "Python and C lay memory out unlike"
        assert self._library.engine_sizes(0) == self._before.nbytes, message
        assert self._library.engine_sizes(1) == self._after.nbytes, message

        # Work of a sample and of other calls: the next feedback needs the preparation's factors.
        work_size = self._library.engine_sizes(2)
        loop_size = self._library.engine_loop_size()
        self._arrays = (
            _room(work_size),
            _room(work_size),
            _room(loop_size),
        )
        work, self._other_work, self._loop = map(_pointer, self._arrays)
        before = _pointer(self._before)
        after = _pointer(self._after)
        action = _pointer(self.action)
        self._value_arguments = (before, work, after, None)
        self._action_value_arguments = (before, work, after, action)
        self._n_states = functions.problem.n_states
        self._n_theta = functions.blocks.size

    @classmethod
    def compile(
        cls,
        functions: NmpcFunctions,
        stagewise: bool | None = None,
    ) -> Engine | None:
        """Compiled engine of a Gauss–Newton controller, or None without a compiler.

        Args:
            functions: The controller's functions, in whose memory the engine works.
            stagewise: Whether the QP is solved stage by stage. None leaves it to the rule
                `solves_by_stage`.
        """
        if stagewise is None:
            stagewise = solves_by_stage(functions.problem)
        sources = controller_sources(functions, stagewise=stagewise)
        # Beside what is exported, the engine has derivatives and closed loops.
        for name in ("sensitivities.h", "loop.h", "fmu.h", "rti_loop.h", "engine.c"):
            sources[name] = (ENGINE_SOURCES / name).read_bytes()
        path = library(sources)
        if path is None:
            return None
        return cls(str(path), functions, stagewise)

    def agrees(self, functions: NmpcFunctions) -> bool:
        """Whether the compiled functions give what CasADi's interpreter gives, at one state.

        Compilers have faults: gcc 12 has been seen to drop the results of a model's linearisation.
        The state is the reference, at the point and θ of the memory, which stays as it is.
        """
        prepared = functions.preparation
        read = functions.readout
        saved = prepared.memory.copy(), read.memory.copy()
        read.inputs["s"][:] = functions.problem.reference_state
        same = self._linearisation_agrees(functions)
        # A QP that is not solved is the feedback's to report: it says nothing of the compiler.
        if same and self.prepare() == 0 and self.feedback(False) == 0:
            same = self._solution_agrees(functions)
        prepared.memory[:], read.memory[:] = saved
        return same

    def _linearisation_agrees(self, functions: NmpcFunctions) -> bool:
        # A QP that cannot be prepared is not the compiler's fault; the feedback reports it.
        if self.prepare() != 0:
            return True
        prepared = functions.preparation
        first = prepared.places["A"].start
        last = prepared.places["r"].stop
        stages = prepared.memory[first:last]
        compiled = stages.copy()
        prepared()
        return _alike(compiled, stages)

    def _solution_agrees(self, functions: NmpcFunctions) -> bool:
        """Whether the read-out and the value's gradient agree at the solution in the memory."""
        prepared = functions.preparation
        read = functions.readout
        compiled = read.stack.copy()
        read()
        same = _alike(compiled, read.stack)

        gradient, _ = functions.derivatives
        # Its inputs are in the one memory or in the other.
        for name, values in gradient.inputs.items():
            source = read if name in read.places else prepared
            values[:] = source.part(name)
        gradient()
        compiled_gradient = read.part("gradient")
        return same and _alike(compiled_gradient, gradient.stack)

    def prepare(self) -> int:
        """Preparation phase at the point and θ that the memory holds."""
        before, work, _, _ = self._value_arguments
        return int(self._library.engine_prepare(before, work))

    def feedback(self, enforced: bool) -> int:
        """Feedback phase for the memory's state, with `action` enforced or not."""
        arguments = self._action_value_arguments if enforced else self._value_arguments
        return int(self._library.engine_feedback(*arguments))

    def solve_batch(self, batch: _Batch) -> NDArray[np.intc]:
        """Solve the QPs of a batch and write their rows.

        Returns:
            Statuses of the QPs, (K,); −1 where the policy's derivatives are left to Python.
        """
        count = len(batch.states)
        statuses = np.empty(count, dtype=np.intc)
        # Copies: a batch leaves the controller's own point and solution as they are.
        before = self._before.copy()
        after = self._after.copy()
        x, u, _ = batch.points
        self._library.engine_batch(
            _pointer(before),
            _pointer(after),
            self._other_work,
            ctypes.c_longlong(count),
            _pointer(batch.states),
            _pointer(batch.enforced),
            _pointer(batch.theta),
            _pointer(x),
            _pointer(u),
            _pointer(batch.actions),
            _pointer(batch.values),
            _pointer(batch.slopes),
            _pointer(statuses),
        )
        return statuses

    def policy(self, before: Vector, after: Vector) -> tuple[Vector, Vector] | None:
        """dπ/dθ (m, n_θ) and dπ/ds (m, n); None if LICQ fails.

        Args:
            before: Memory of the preparation, or a copy.
            after: Memory of the read-out, or a copy, with a solution of the QP.
        """
        m = self.action.size
        # C writes both into one array, dπ/dθ first.
        split = m * self._n_theta
        jacobians: Vector = np.empty(split + m * self._n_states)
        failed = self._library.engine_policy(
            _pointer(before),
            _pointer(after),
            self._other_work,
            _pointer(jacobians),
        )
        if failed:
            return None
        by_theta = jacobians[:split].reshape(m, self._n_theta)
        by_state = jacobians[split:].reshape(m, self._n_states)
        return by_theta, by_state

    def begin(self) -> None:
        """Make ready for a closed loop: no earlier sample is known."""
        before, work, after, _ = self._value_arguments
        self._library.engine_begin(self._loop, before, after, work)

    def run(self, plant: Any, first: int, table: Vector) -> tuple[int, int, int]:
        """Run the plant in a closed loop; other threads run meanwhile.

        Args:
            plant: An instance's `native`.
            first: Number of the first sample.
            table: Where the samples go, a row each, as long as the loop is to run.

        Returns:
            The number of the sample that the loop came to, what failed there (0 where nothing did)
            and FMI's status.
        """
        fault = (ctypes.c_int * 2)()
        reached = self._library.engine_run(
            self._loop,
            ctypes.byref(plant),
            ctypes.c_longlong(first),
            ctypes.c_longlong(first + len(table)),
            ctypes.c_void_p(table.ctypes.data),
            fault,
        )
        return reached, fault[0], fault[1]


def _room(size: int) -> Vector:
    """Memory of at least `size` bytes."""
    return np.zeros(size // 8 + 1)


def _pointer(array: NDArray[Any] | None) -> ctypes.c_void_p | None:
    """Pointer to the numbers of an array, which its caller keeps; null for None."""
    if array is None:
        return None
    return ctypes.c_void_p(array.ctypes.data)


class RtiNmpc:
    """NMPC by the real-time iteration scheme, as action value Q, value V and policy π of θ.

        V(s) = λ_θ(s) + p(s) + Σ_{k<N} γᵏ ℓ_θ(x_k, u_k) + γᴺ V^f_θ(x_N) + Σ_{1≤k≤N} γᵏ p_θ(σ_k)

    minimised over the QP of the linearised dynamics (paper.tex eq. param_nmpc, param_nlp_qp), where
    p is the penalty of the true bounds at the known state s, p_θ(σ) = w_sigmaᵀσ + σᵀW_sigma σ that
    of the predicted slack, and Q(s, a) enforces u_0 = a.

    A sample is `prepare()`, which shifts the solution of the last `feedback` and linearises along
    it, then `feedback(s)`. A second `prepare()` without a feedback in between changes nothing, and
    `feedback(s, a)` after `feedback(s)` uses the same QP data.

    With `iterations` above 1 a feedback solves that many QPs, each linearised at the solution of
    the last, full steps at the measured state: many end at `ConvergedNmpc`. Value, policy and
    derivatives are then those of the last QP at its own point of linearisation; the QP of `prepare`
    stays for the sample's other feedbacks, so that Q(s, π(s)) = V(s), and replay.

    `functions` says whether a sample is `interpreted` or `compiled` (see `compile`).

    Args:
        problem: The control problem.
        parameters: θ.
        hessian: `gauss-newton` or `exact`.
        backend: `daqp`, `proxqp`, `qpsolvers:SOLVER`, or a function that makes a `QpBackend`. What
            `daqp` leaves unsolved of an unstable model is tried once more in stabilised controls.
        iterations: Number of QPs a feedback.

    Raises:
        ControllerError: Another choice of Hessian, backend or iterations.

    Example:
        >>> problem = Problem.from_scenario(Scenario.load("paper"))
        >>> controller = RtiNmpc(problem, Parameters.naive(problem))
        >>> controller.prepare()
        >>> controller.feedback([25.5, 50.0]).action.round(2)
        array([191.72, 215.9 ])
    """

    name = "rti"
    memoryless = True
    """A feedback depends on θ, its point of linearisation, s and a alone."""

    def __init__(
        self,
        problem: Problem,
        parameters: Parameters,
        *,
        hessian: str = "gauss-newton",
        backend: str | Callable[[], QpBackend] = "daqp",
        iterations: int = 1,
    ) -> None:
        if iterations < 1:
            raise ControllerError(f"iterations must be at least 1, not {iterations}")
        self.iterations = iterations
        self.problem = problem
        self._compilable = hessian == "gauss-newton" and backend == "daqp"
        self._chosen_backend = backend
        self._make_backend: Callable[[], QpBackend]
        if isinstance(backend, str):
            self._make_backend = partial(make_backend, backend)
        else:
            self._make_backend = backend
        self._functions = NmpcFunctions(problem, parameters.blocks, hessian)
        self._prepare = self._functions.preparation
        self._embed = self._functions.embedding
        self._readout = self._functions.readout
        self._hessian = self._functions.hessian
        self._engine: Engine | None = None
        self._prepared: Prepared | None = None
        # Status of the engine's last preparation.
        self._status = 0
        self._view_memory()
        self.parameters = parameters
        self.functions = INTERPRETED
        self.reset()

    def _view_memory(self) -> None:
        """Name the parts of the functions' memory that hold the QP, its point and its solution."""
        problem = self.problem
        horizon = problem.horizon
        prepare = self._prepare
        self._qp = self._functions.qp(prepare.memory, self._readout.memory)
        action_lower = self._scaled(problem.action_lower)
        action_upper = self._scaled(problem.action_upper)
        self._action_bounds = (action_lower, action_upper)
        # The actions' bounds stay, but for those of u_0, which an enforced action replaces.
        self._qp.lower[:] = np.tile(action_lower, horizon)
        self._qp.upper[:] = np.tile(action_upper, horizon)
        # The slack's weights in units of `Problem.scale`: a cost for each unit of a state, and of
        # its square; and how much the rows of the stages 1 … N weigh, (Nn,).
        scale = problem.scale
        self._price = scale.state_price
        self._quadratic_unit = scale.state / self._price
        self._slack_discounts = np.repeat(problem.discounts[1:], problem.n_states)
        self._weigh(problem.penalty_linear, problem.penalty_quadratic)
        self._x = prepare.part("x").reshape(horizon, -1)
        self._u = prepare.part("u").reshape(horizon, -1)
        self._costates = prepare.part("costates").reshape(horizon, -1)
        # The values of each varying quantity at the stages 0 … N, which stand behind θ.
        behind = prepare.inputs["theta"][self._functions.blocks.size :]
        sigma = behind.reshape(horizon + 1, len(problem.varying))
        self._signal_columns = [
            (item.signal, sigma[:, row]) for row, item in enumerate(problem.varying)
        ]
        self._constant = prepare.part("constant")

        # The point of linearisation and the read-out's next one, each in one piece: a shift copies.
        prepared = prepare.places
        point = slice(prepared["x"].start, prepared["u"].stop)
        self._point = prepare.memory[point]
        self._dense = slice(prepared["H"].start, prepared["F"].stop)
        read = self._readout.places
        self._next_point = slice(read["next_x"].start, read["next_u"].stop)
        self._next_costates = read["next_chi"]
        self._value_place = read["value"].start
        first = read["v"].start
        self._first_action = slice(first, first + problem.n_actions)

    def compile(self, samples: int = LONG) -> None:
        """Compile for a run of `samples`, if it is long enough; call this before the first sample.

        COSIM_COMPILE=never forbids it, `now` compiles for any number. Without a compiler, for the
        exact Hessian and for backends other than `daqp` CasADi's interpreter stays. Both give the
        same to rounding and to DAQP's accuracy (`tests/controllers/rti/test_engine.py` holds the
        bounds).
        """
        if not self._compilable or not worth_compiling(samples):
            return
        reason = why_not_in_c(self._functions)
        if reason is not None:
            self._compilable = False
            warn(f"{reason}: the controller is not compiled, which is slower", ModelWarning)
            return
        # A library that differs from the interpreter is refused: it would give wrong numbers fast.
        engine = Engine.compile(self._functions)
        if engine is not None and not engine.agrees(self._functions):
            warn(
                "the compiled model and CasADi's give different numbers: the controller "
                "is not compiled, which is slower; set CC to another compiler",
                ModelWarning,
            )
            engine = None
        self._engine = engine
        self.functions = INTERPRETED if engine is None else COMPILED
        self._compilable = engine is not None  # where it failed once it is not tried again
        self._prepared = None

    # θ ------------------------------------------------------------------------------------------

    @property
    def parameters(self) -> Parameters:
        """Parameters θ; setting them keeps the guess and makes the next feedback prepare anew.

        Raises ParameterError where the blocks differ, a learned lower bound is not below the
        upper one or a slack weight is not positive.
        """
        return self._parameters

    @parameters.setter
    def parameters(self, parameters: Parameters) -> None:
        # The constructor sets θ through here too, when there is none yet.
        current = getattr(self, "_parameters", parameters)
        blocks = parameters.blocks
        if blocks is not current.blocks and blocks != current.blocks:
            raise ParameterError(
                "θ has other blocks than the controller was built with: "
                f"{', '.join(blocks.slices)}; build a new controller for it"
            )
        parameters.require_well_posed()
        self._parameters = parameters
        # All that depends on θ alone is written here; the rest is the next preparation's.
        self._hessian.set_parameters(parameters)
        self._prepare.inputs["theta"][: blocks.size] = parameters.theta
        if "w_sigma" in blocks:
            self._weigh(parameters["w_sigma"], parameters["W_sigma"])
        self._prepared = None

    @property
    def theta(self) -> Vector:
        """θ as a flat read-only vector, (n_θ,); set it like `parameters`."""
        return self._parameters.theta

    @theta.setter
    def theta(self, theta: ArrayLike) -> None:
        self.parameters = self._parameters.with_theta(theta)

    # signals ------------------------------------------------------------------------------------

    def inform(self, known: Mapping[str, Vector]) -> None:
        """Take up what is known of the scenario's signals at the sample to come.

        It holds until the next call; after a reset every signal has its nominal value.
        Beyond its last known value a signal keeps that.

        Args:
            known: Of each known signal, by its name, its value at the sample and, of a preview, at
                those after it.

        Raises:
            ControllerError: A signal of the problem is not among them, or has no finite values.
        """
        if not self._signal_columns:
            return
        for signal, column in self._signal_columns:
            values = known.get(signal)
            if values is None:
                raise ControllerError(f"nothing is known of the problem's signal '{signal}'")
            # What is read-only is the scenario's own, which was checked when it was read.
            if values.flags.writeable and not _are_finite(values):
                raise ControllerError(
                    f"signal '{signal}' must be known by finite values, its present one first"
                )
            hold_last(column, values)
        # The last preparation is of other values.
        self._prepared = None

    def tighten(self, lower: Vector, upper: Vector) -> None:
        """Move the bounds of the predicted states inwards for the feedbacks that follow.

        It holds until the next call, until θ is set, or until a reset. Bounds belong to the
        feedback phase: the preparation stays.

        Args:
            lower: By how much each lower bound rises, (n,).
            upper: By how much each upper bound falls, (n,).
        """
        parameters = self._parameters
        places = parameters.blocks.slices
        memories = [self._prepare.inputs["theta"]]
        if self._prepared is not None:
            # The solution's derivatives are computed from this copy.
            memories.append(self._prepared.part("theta"))
        for theta in memories:
            theta[places["x_l"]] = parameters["x_l"] + lower
            theta[places["x_u"]] = parameters["x_u"] - upper

    # the two phases -----------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget all earlier samples: the next QP is linearised at the reference steady state."""
        self._x[:] = self.problem.reference_state
        self._u[:] = self.problem.reference_action
        self._costates[:] = 0.0
        self._prepare.inputs["theta"][:] = nominal_given(self.problem, self.theta)
        self._pending: RtiSolution | None = None
        self._prepared = None
        # A backend may remember: a new one does not.
        self._backend = self._make_backend()

    def prepare(self) -> None:
        """Preparation phase: shift the last solution, linearise along it, condense, factorise.

        The shift drops the first stage, repeats the last control and, since stage N is not
        linearised, needs no state beyond the predicted x_N.
        """
        if self._pending is not None:
            memory = self._pending.memory
            self._pending = None
            # The read-out has computed the shift: what is left is to copy it.
            self._point[:] = memory[self._next_point]
            self._costates.reshape(-1)[:] = memory[self._next_costates]
            self._prepared = None
        if self._prepared is None:
            self._linearise()

    def prepare_at(self, point: LinearisationPoint) -> None:
        """Prepare at a given point without shifting, as replay does.

        Raises ControllerError where an array has a wrong shape or is not finite, and then changes
        nothing; QpError where the QP is not finite.
        """
        targets = (self._x, self._u, self._costates)
        arrays = [np.asarray(values, dtype=np.float64) for values in point]
        for name, target, array in zip(point._fields, targets, arrays, strict=True):
            # A sum is finite only if all of its terms are, and costs less than NumPy's test.
            total = sum(array.reshape(-1).tolist())
            if array.shape != target.shape or not isfinite(total):
                raise ControllerError(
                    f"linearisation point: {name} must be finite with shape {target.shape}, "
                    f"not {array.shape}"
                )
        self._pending = None
        self._linearise_at(LinearisationPoint(*arrays))

    def _linearise_at(self, point: LinearisationPoint) -> None:
        """Make a point the guess and linearise there."""
        self._set_point(point)
        self._linearise()

    def _set_point(self, point: LinearisationPoint) -> None:
        """Make a point the guess, at which the next QP is linearised."""
        self._x[:] = point.x
        self._u[:] = point.u
        self._costates[:] = point.costates

    def _weigh(self, w: Vector, W: Vector) -> None:
        """Give the slack of the predicted stages its weights (n,), discounted."""
        horizon = self.problem.horizon
        linear = w / self._price
        quadratic = W * self._quadratic_unit
        # Make new views: a backend recognises new weights by them.
        self._qp.w = self._prepare.part("w")
        self._qp.W = self._prepare.part("W")
        self._qp.w[:] = self._slack_discounts * np.tile(linear, horizon)
        self._qp.W[:] = self._slack_discounts * np.tile(quadratic, horizon)

    def _scaled(self, action: Vector) -> Vector:
        """The QP's variables that stand for an action (m,)."""
        problem = self.problem
        deviation = action - problem.reference_action
        return np.asarray(deviation / problem.scale.action)

    def _linearise(self) -> None:
        """Make the QP at the guess and factorise it."""
        self._make_qp()
        if self._engine is None:
            self._backend.load(self._qp)
        self._prepared = self._keep_preparation(self._engine)

    def _make_qp(self) -> None:
        """Linearise at the guess and condense; raises QpError where the QP is not finite."""
        # A QP that fails here must not be taken for the one before.
        self._prepared = None
        if self._engine is not None:
            self._status = self._engine.prepare()
            finite = self._status != NOT_FINITE
        else:
            self._constant[0] = self._hessian.fill(self._x, self._u, self._costates)
            self._prepare()
            finite = self._prepare.finite()
        if not finite:
            raise self._failure(
                "the QP is not finite: the model has no finite value or derivative at the point of "
                "linearisation",
                "QP not finite",
            )

    def _keep_preparation(self, engine: Engine | None) -> Prepared:
        """A copy of the preparation for read-outs, by an engine or, without one, by Python."""
        source = self._prepare.memory
        if engine is not None and engine.stagewise:
            # All but the dense matrices, most of the memory, which were not condensed.
            dense = self._dense
            memory = np.empty_like(source)
            memory[: dense.start] = source[: dense.start]
            memory[dense.stop :] = source[dense.stop :]
        else:
            memory = source.copy()
        return Prepared(memory, self._hessian.spectrum, self._functions, engine)

    def _failure(self, message: str, status: str) -> QpError:
        """An error with a copy of the QP, which compiled code may have left uncondensed."""
        self._prepare()
        self._embed()
        return QpError(
            message + self._hint(),
            status=status,
            qp=self._qp.copy(),
        )

    def _hint(self) -> str:
        """Possible cause of a QP without a solution: a coarse integration."""
        integration = self._functions.integration
        if not integration.coarse:
            return ""
        return f"; the model is integrated coarsely: {integration.remedy}"

    @property
    def linearisation_point(self) -> LinearisationPoint:
        """Point at which the QP is prepared, for replay by `prepare_at`."""
        if self._prepared is None:
            self.prepare()
        assert self._prepared is not None
        return self._prepared.point

    def feedback(self, s: ArrayLike, a: ArrayLike | None = None) -> RtiSolution:
        """Feedback phase: V(s) and π(s), or Q(s, a) where `a` is given.

        The next `prepare` shifts this solution.

        Args:
            s: State in the model's units, (n,).
            a: Action to enforce in the model's units, (m,): it replaces the bounds of u_0. None
                leaves the action to the policy.

        Returns:
            The solution of the QP; its derivatives are computed when they are asked for.

        Raises:
            QpError: s is not finite, or the QP is not solved.
            ControllerError: An array has a wrong shape.
        """
        solution = self._solve(s, a)
        self._pending = solution
        return solution

    def _solve(self, s: ArrayLike, a: ArrayLike | None) -> RtiSolution:
        solution = self._solve_qp(s, a)
        if self.iterations > 1:
            # The sample's other feedbacks begin where `prepare` linearised, so put that back.
            prepared = self.linearisation_point
            try:
                for _ in range(self.iterations - 1):
                    self._linearise_at(solution.unshifted)
                    solution = self._solve_qp(s, a)
            finally:
                self._linearise_at(prepared)
        return solution

    def _solve_qp(self, s: ArrayLike, a: ArrayLike | None) -> RtiSolution:
        """Solve the prepared QP for a state; raises QpError where it is not solved."""
        problem = self.problem
        # Check before anything is written: a wrong shape leaves the controller as it was.
        state = _vector("state", s, problem.reference_state.size)
        action = None
        if a is not None:
            action = _vector("action", a, problem.reference_action.size)
        if self._prepared is None:
            self.prepare()
        prepared = self._prepared
        assert prepared is not None
        self._readout.inputs["s"][:] = state
        try:
            if self._engine is None:
                finite = self._solve_interpreted(action)
            else:
                # The status of a preparation that failed is that of the feedback.
                status = self._solve_compiled(self._engine, action)
                finite = status != NOT_FINITE
                if status not in (0, NOT_FINITE):
                    if not self._engine.stagewise:
                        word = STATUSES[status]
                        raise self._failure(f"the QP was not solved: {word}", word)
                    # What is left unsolved stage by stage is solved condensed.
                    prepared = self._condense()
                    finite = self._solve_interpreted(action)
        except QpError as error:
            if prepared.engine is None:  # the backend knows nothing of the model
                error.args = (f"{error}{self._hint()}",)
            raise
        if not finite:
            message = f"the QP is not finite: state {state}, action {action!r}"
            raise self._failure(message, "state or action not finite")
        return self._solution(prepared, enforced=action is not None)

    def _solution(self, prepared: Prepared, *, enforced: bool) -> RtiSolution:
        """The solution in the read-out's memory."""
        problem = self.problem
        # One copy keeps the whole solution; the next feedback writes over the memory.
        memory = self._readout.memory.copy()
        deviation = memory[self._first_action] * problem.scale.action
        return RtiSolution(
            action=deviation + problem.reference_action,
            value=float(memory[self._value_place]),
            prepared=prepared,
            memory=memory,
            enforced=enforced,
        )

    def _solve_compiled(self, engine: Engine, a: Vector | None) -> int:
        """Solve in compiled code; 0 or a status."""
        if a is not None:
            engine.action[:] = a
        # Where the preparation has failed there is no QP to solve.
        return self._status or engine.feedback(a is not None)

    def _condense(self) -> Prepared:
        """Make the condensed QP at an engine's point, and the preparation without the engine."""
        self._prepare()
        self._backend.load(self._qp)
        return self._keep_preparation(None)

    def _solve_interpreted(self, a: Vector | None) -> bool:
        """Solve by CasADi's functions and the backend; whether state and action are finite."""
        # A solver would loop or crash on numbers that are not finite.
        if not self._embed_state(a):
            return False
        enforced = a is not None
        try:
            solution = self._backend.solve(self._qp)
            self._accept(solution, enforced=enforced)
        except QpError as error:
            if not self._solves_again or not self._solve_again(enforced):
                raise error from None
        return True

    @cached_property
    def _solves_again(self) -> bool:
        """Whether what the backend leaves unsolved is tried in stabilised controls.

        It is where the compiled controller solves stage by stage for the same reason, so that a
        stable model's sample fails or not however it is computed.
        """
        unstable = growth_over_horizon(self.problem) > GROWTH_LIMIT
        return self._chosen_backend == "daqp" and unstable

    def _solve_again(self, enforced: bool) -> bool:
        """Solve in stabilised controls what DAQP has left unsolved condensed; whether that is done.

        The condensed QP of an unstable model is convex, but so badly conditioned that DAQP loses
        its way, and a sample without a solution costs such a plant dearly.
        """
        try:
            solution = solve_stabilised(self._stages(), self._initial_state())
        except QpError:
            return False
        # Not polished: that would take Newton steps on the condensed QP.
        return self._read(solution, enforced) <= SOLVED_RESIDUAL

    def _stages(self) -> Stages:
        """The QP as prepared, stage by stage, with the present bounds of the controls."""
        problem = self.problem
        horizon = problem.horizon
        n = problem.n_states
        width = n + problem.n_actions
        part = self._prepare.part
        # Not θ's own: they may be tightened.
        theta = self._prepare.inputs["theta"]
        places = self._parameters.blocks.slices
        x_s = problem.reference_state
        state_scale = problem.scale.state
        return Stages(
            A=part("A").reshape(horizon, n, n),
            B=part("B").reshape(horizon, n, -1),
            r=part("r").reshape(horizon, n),
            L=part("L").reshape(horizon, width, width),
            q=part("q").reshape(horizon, width),
            L_N=part("L_N").reshape(n, n),
            q_N=part("q_N"),
            lower=self._qp.lower,
            upper=self._qp.upper,
            state_lower=(theta[places["x_l"]] - x_s) / state_scale,
            state_upper=(theta[places["x_u"]] - x_s) / state_scale,
            w=self._qp.w,
            W=self._qp.W,
        )

    def _initial_state(self) -> Vector:
        """ξ_0 of the state in the read-out's memory, (n,)."""
        deviation = self._readout.inputs["s"] - self.problem.reference_state
        return np.asarray(deviation.reshape(-1) / self.problem.scale.state)

    def _embed_state(self, a: Vector | None) -> bool:
        """Put the state, and an action to enforce, into the QP; whether all is finite."""
        m = self.problem.n_actions
        self._embed()
        self._readout.inputs["constant"][0] = self._constant[0]
        # The bounds of u_0 may still be an action that the last feedback enforced.
        lower, upper = self._action_bounds
        if a is not None:
            lower = upper = self._scaled(a)
        self._qp.lower[:m] = lower
        self._qp.upper[:m] = upper
        finite = self._embed.finite()
        # An enforced action is no input of the embedding, whose results were looked at.
        if a is not None:
            finite = finite and all(map(isfinite, a.tolist()))
        return finite

    def _accept(self, solution: QpSolution, *, enforced: bool) -> None:
        """Read a solution out, polished if need be; raises QpError where it is inaccurate."""
        residual = self._read(solution, enforced)
        if not residual <= ACCURATE_RESIDUAL:
            # Most solutions are accurate at once and need no Newton step.
            residual = self._read(polish(self._qp, solution), enforced)
        if not residual <= SOLVED_RESIDUAL:
            raise QpError(
                f"the QP was solved too inaccurately: its KKT residual is {residual:.1e}, more "
                f"than {SOLVED_RESIDUAL:g}; is the model unstable over so long a horizon?",
                status=INACCURATE,
                qp=self._qp.copy(),
            )

    def _read(self, solution: QpSolution, enforced: bool) -> float:
        """Read a solution of the QP out; its residual."""
        # Which multipliers a backend returns at a kink is an accident: choose them.
        if enforced:
            solution = multipliers_at_kink(self._qp, solution, *self._action_bounds)
        read = self._readout
        read.inputs["v"][:] = solution.v
        read.inputs["nu"][:] = solution.nu
        read.inputs["lam"][:] = solution.lam
        read()
        return float(read.part("residual")[0])

    def compiled_loop(self, scenario: Scenario) -> CompiledLoop | None:
        """A new closed loop in compiled code; None if only Python can run it.

        That is before `compile`, with several iterations, where the QP is solved stage by stage,
        since what that leaves unsolved is solved in Python, in a subclass that samples otherwise,
        and where the scenario saturates otherwise than the problem.
        """
        engine = self._engine
        problem = self.problem
        if engine is None or engine.stagewise or self.iterations > 1:
            return None
        # A subclass that overrides a phase would be passed over by the loop in C.
        kind = type(self)
        same_prepare = kind.prepare is RtiNmpc.prepare
        same_feedback = kind.feedback is RtiNmpc.feedback
        if not (same_prepare and same_feedback):
            return None
        for name in ("action_lower", "action_upper", "reference_action"):
            of_scenario = getattr(scenario, name)
            of_problem = getattr(problem, name)
            if not np.array_equal(of_scenario, of_problem):
                return None
        # A plant may have more states than the model, which the loop in C does not pick.
        if len(scenario.plant.states) != problem.n_states:
            return None
        self.reset()
        engine.begin()
        return engine.run

    # read-outs that leave the guess alone -------------------------------------------------------

    def value(self, s: ArrayLike) -> float:
        """V(s) of the prepared QP."""
        return self._solve(s, None).value

    def feedback_batch(
        self,
        states: ArrayLike,
        theta: ArrayLike | None = None,
        enforced: ArrayLike | None = None,
        points: LinearisationPoint | None = None,
        *,
        derivatives: bool = False,
    ) -> BatchSolution:
        """π and V at many states, or Q where actions are enforced; the controller keeps its own.

        Args:
            states: States s, (K, n).
            theta: θ, (n_θ,) or (K, n_θ); the controller's own where it is None.
            enforced: Actions a, (m,) or (K, m), where Q(s, a) is wanted.
            points: Points of linearisation, arrays of one or of K rows; the controller's own where
                they are None.
            derivatives: Whether to compute them too.

        Returns:
            A row a state; π and V are NaN where a QP is not solved.

        Raises:
            ControllerError: An array has a wrong shape.
        """
        if self._prepared is None:
            self.prepare()
        n = self.problem.n_states
        m = self.problem.n_actions
        if np.ndim(states) != 2:
            raise ControllerError(f"the states must have shape (K, {n}), not {np.shape(states)}")
        count = len(np.asarray(states))
        actions = None
        if enforced is not None:
            actions = _batch_rows("actions", enforced, count, (m,))
        if theta is None:
            theta = self.theta
        guess = self._guess()
        if points is None:
            points = guess
        point_rows = []
        for part, present in zip(points, guess, strict=True):
            point_rows.append(_batch_rows("points", part, count, present.shape))
        batch = _Batch(
            _batch_rows("states", states, count, (n,)),
            actions,
            _batch_rows("θ", theta, count, self.theta.shape),
            LinearisationPoint(*point_rows),
            derivatives=derivatives,
        )

        # Python solves what compiled code does not, one row after the other.
        rest = np.arange(count)
        if self._engine is not None and self.iterations == 1:
            statuses = self._engine.solve_batch(batch)
            left = statuses < 0
            if self._engine.stagewise:  # what is left unsolved stage by stage is solved condensed
                left |= statuses > 0
            rest = np.flatnonzero(left)
        if len(rest):
            self._solve_rows(batch, rest.tolist())
        return batch.solution()

    def _guess(self) -> LinearisationPoint:
        """A copy of the point of linearisation."""
        return LinearisationPoint(
            x=self._x.copy(),
            u=self._u.copy(),
            costates=self._costates.copy(),
        )

    def _solve_rows(self, batch: _Batch, rows: Iterable[int]) -> None:
        """Solve rows of a batch one after the other, then be as before."""
        parameters = self._parameters
        pending = self._pending
        guess = self._guess()
        try:
            for k in rows:
                # A row without a solution stays NaN.
                with suppress(QpError, ParameterError):
                    self.theta = batch.theta[k]
                    self._pending = None
                    self._linearise_at(batch.point(k))
                    a = None if batch.enforced is None else batch.enforced[k]
                    solution = self._solve(batch.states[k], a)
                    batch.write(k, solution)
        finally:
            self.parameters = parameters
            self._linearise_at(guess)
            self._pending = pending

    def action_value(self, s: ArrayLike, a: ArrayLike) -> float:
        """Q(s, a) of the prepared QP."""
        return self._solve(s, a).value

    def policy(self, s: ArrayLike) -> Vector:
        """π(s) of the prepared QP, (m,)."""
        return self._solve(s, None).action


def compile_functions(controller: object, samples: int = LONG) -> None:
    """Compile the controller if it is an `RtiNmpc`, and the estimator before it; no other."""
    if isinstance(controller, RtiNmpc):
        if controller.functions == INTERPRETED:
            controller.compile(samples)
    elif isinstance(getattr(controller, "controller", None), RtiNmpc):
        controller.compile(samples)  # type: ignore[attr-defined]


def _alike(one: Vector, other: Vector) -> bool:
    """Whether two vectors are equal but for rounding, relative to the largest entry."""
    # Optimised code may round otherwise; a lost result is off by its own size.
    size = float(np.abs(other).max(initial=0.0))
    same = np.allclose(
        one,
        other,
        rtol=0.0,
        atol=1e-9 * size,
        equal_nan=True,
    )
    return bool(same)


def _batch_rows(
    kind: str,
    values: ArrayLike,
    count: int,
    shape: tuple[int, ...],
) -> Vector:
    """Rows (count, *shape) of values that have this shape, or are one row for all."""
    rows = np.asarray(values, dtype=np.float64)
    batch_shape = (count, *shape)
    if rows.shape not in (shape, batch_shape):
        raise ControllerError(f"the {kind} must have shape {batch_shape}, not {rows.shape}")
    return np.ascontiguousarray(np.broadcast_to(rows, batch_shape))


def _are_finite(values: Vector) -> bool:
    """Whether values are at least one finite number, in a row."""
    return values.ndim == 1 and values.size > 0 and bool(np.isfinite(values).all())


def _vector(kind: str, values: ArrayLike, size: int) -> Vector:
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (size,):
        raise ControllerError(f"the {kind} must have {size} entries, not shape {vector.shape}")
    return vector
