"""Real-time-iteration NMPC: one QP a sample, prepared before the state is known; its solution."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controllers.errors import ControllerError, ModelWarning, ParameterError, QpError, warn
from controllers.export.core import (
    SOURCES,
    STACK_LIMIT,
    STATUSES,
    controller_sources,
    stack_needed,
    why_not_in_c,
)
from controllers.functions import COMPILED, INTERPRETED, LONG, StackedFunction, library, switch
from controllers.preparation import RESIDUAL, Exact, SampleFunctions, Spectrum
from controllers.problem import Problem
from controllers.qp import (
    QpBackend,
    QpSolution,
    SoftQp,
    make_backend,
    multipliers_at_kink,
    polish,
)
from controllers.sensitivities import (
    SOLUTION,
    adjoint_directions,
    curvature_directions,
    sensitivities,
)
from controllers.theta import Parameters
from cosim.core.protocols import CompiledLoop, Matrix, Vector
from cosim.core.scenario import Scenario


class LinearisationPoint(NamedTuple):
    """Where a QP is linearised: states x (N, n), actions u (N, m), costates (N, n).

    The state at stage N is not needed since the terminal cost is quadratic; the costates χ_1 … χ_N
    matter for the exact Hessian only.
    """

    x: Matrix
    u: Matrix
    costates: Matrix


class Functions(SampleFunctions):
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
        return super().named | {"GRADIENT": gradient, "POLICY": make_policy()}

    def condense(self, before: Vector, after: Vector) -> None:
        """Write the condensed QP into copies of both memories."""
        own = self.preparation.memory, self.readout.memory
        kept = [memory.copy() for memory in own]
        own[0][:], own[1][:] = before, after
        self.preparation()
        self.embedding()
        before[:], after[:] = own
        own[0][:], own[1][:] = kept


@dataclass(eq=False)
class Prepared:
    """Data of a preparation phase, kept for read-outs after the next one has begun.

    `memory` is a copy of the preparation's memory. `spectrum` is that of the exact Hessian's blocks
    before the lift that made them convex. `functions` and `engine` are the controller's. An engine
    that solves stage by stage condenses the QP only when it is asked for.
    """

    memory: Vector
    spectrum: Spectrum | None
    functions: Functions
    engine: Engine | None = None

    def part(self, name: str) -> Vector:
        """An input, result or other part of the preparation's memory, flat."""
        return self.functions.preparation.part(name, self.memory)

    @cached_property
    def point(self) -> LinearisationPoint:
        """Where the QP is linearised."""
        horizon = self.functions.problem.horizon
        parts = (self.part(name) for name in LinearisationPoint._fields)
        return LinearisationPoint(*(part.reshape(horizon, -1).copy() for part in parts))

    def contract(self, seed: Vector) -> Vector:
        """Adjoint of the lift's derivative (`Spectrum.contract`), of the identity without one."""
        return seed if self.spectrum is None else self.spectrum.contract(seed)


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
        return QpSolution(*(self._part(name) for name in ("v", "nu", "lam")))

    @cached_property
    def qp(self) -> SoftQp:
        """The condensed QP that was solved, in units of `Problem.scale`."""
        functions, prepared = self.prepared.functions, self.prepared
        if prepared.engine is not None and prepared.engine.stagewise:
            functions.condense(prepared.memory, self.memory)
        return functions.qp(prepared.memory, self.memory)

    @cached_property
    def predicted_states(self) -> Matrix:
        """Predicted states x_0 … x_N, shape (N+1, n)."""
        return self._by_stage("xi") + self.prepared.functions.problem.reference_state

    @cached_property
    def predicted_actions(self) -> Matrix:
        """Predicted actions u_0 … u_{N−1}, shape (N, m)."""
        problem = self.prepared.functions.problem
        moved = self.multipliers.v.reshape(-1, problem.n_actions) * problem.scale.action
        return np.asarray(moved + problem.reference_action)

    @property
    def unshifted(self) -> LinearisationPoint:
        """The solution, not shifted, as a point of linearisation for the same sample."""
        return LinearisationPoint(
            self.predicted_states[:-1], self.predicted_actions, self.costates[1:]
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
        if not self.enforced:
            return np.zeros(self.action.size)
        price = self.prepared.functions.problem.scale.action_price
        return np.asarray(-self.multipliers.nu[: self.action.size] * price)

    @property
    def residual(self) -> float:
        """Largest KKT residual, without a unit: see `readout`. `solved` was said after a look."""
        return float(self._part("residual")[0])

    @property
    def iterations(self) -> int | None:
        """Steps of the compiled QP solver; None where another one solved."""
        return None if self.prepared.engine is None else int(self._part("iterations")[0])

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
        m, prepared = self.action.size, self.prepared
        if prepared.engine is not None:
            found = prepared.engine.policy(prepared.memory, self.memory)
            if found is not None:
                return found
        dv, dt, dlam = adjoint_directions(self.qp, self.multipliers, m)
        function = prepared.functions.derivatives[1]()
        self._write_solution(function)
        inputs = function.inputs
        for name, direction in (("dv", dv), ("dt", dt), ("dlam", dlam)):
            inputs[name][:] = direction.reshape(-1)
        if "dM" in inputs:
            step = self._step_from_point()
            scale = prepared.functions.problem.scale
            moved = curvature_directions(self.qp.rows, dv, step, prepared.contract, scale)
            inputs["dM"][:] = moved.reshape(-1)
        function()
        by_theta, by_state = (function.part(name).reshape(m, -1) for name in ("policy", "state"))
        return by_theta.copy(), by_state.copy()

    def _write_solution(self, function: StackedFunction) -> None:
        inputs, prepared = function.inputs, self.prepared
        for name in SOLUTION:
            inputs[name][:] = self._part(name)
        for name in inputs.keys() & {"x", "u", "theta", "A", "B", "L", "L_N"}:
            inputs[name][:] = prepared.part(name)
        if "M" in inputs:
            step = self._step_from_point()
            seed = step[:, :, None] * step[:, None, :] / 2
            inputs["M"][:] = prepared.contract(seed).reshape(-1)
            inputs["guess"][:] = prepared.part("costates")

    def _step_from_point(self) -> Matrix:
        """Δw of each stage, shape (N, n+m)."""
        point = self.prepared.point
        return np.concatenate(
            [self.predicted_states[:-1] - point.x, self.predicted_actions - point.u], axis=1
        )


NOT_FINITE = STATUSES.index("not finite")
INACCURATE = "inaccurate"
"""Status of the QpError of a QP whose solution is not accurate enough to be used."""
ACCURATE = 1e-9
"""KKT residual above which a solution is polished."""


class Engine:
    """Prepares and solves in the memory of a controller's `functions`; `compile` makes one.

    `prepare` and `feedback` return 0, or a status of the QP solver's. `action` (m,) is where the
    action to enforce is written.
    """

    def __init__(self, path: str, functions: Functions, stagewise: bool) -> None:
        self.stagewise = stagewise
        self._library = library_ = ctypes.CDLL(path)
        before, after = self._memory = functions.preparation.memory, functions.readout.memory
        library_.engine_sizes.restype = library_.engine_loop_size.restype = ctypes.c_size_t
        library_.engine_run.restype = ctypes.c_longlong
        sizes = [library_.engine_sizes(kind) for kind in range(3)]
        assert sizes[:2] == [before.nbytes, after.nbytes], "Python and C lay memory out unlike"
        work, other = np.zeros((2, sizes[2] // 8 + 1))
        loop = np.zeros(library_.engine_loop_size() // 8 + 1)
        self.action: Vector = np.zeros(functions.problem.n_actions)
        # These pointers keep their arrays.
        at_before, at_work, at_after, action, self._other, self._loop = (
            array.ctypes.data_as(ctypes.c_void_p)
            for array in (before, work, after, self.action, other, loop)
        )
        self._value = (at_before, at_work, at_after, None)
        self._action_value = (at_before, at_work, at_after, action)
        self._sizes = self.action.size, functions.blocks.size, functions.problem.n_states

    @classmethod
    def compile(cls, functions: Functions) -> Engine | None:
        """Compiled engine of a Gauss–Newton controller, or None without a compiler.

        A QP of many stages, or too large for an exported controller, is solved stage by stage.
        """
        problem = functions.problem
        # A rule of thumb: where stage by stage becomes faster depends on the plant and on θ.
        stagewise = problem.horizon >= 5 * (problem.n_states + problem.n_actions)
        stagewise = stagewise or stack_needed(functions) > STACK_LIMIT
        sources = controller_sources(functions, stagewise=stagewise)
        for name in ("sensitivities.h", "loop.h", "engine.c"):
            sources[name] = (SOURCES / name).read_bytes()
        path = library(sources)
        return None if path is None else cls(str(path), functions, stagewise)

    def agrees(self, functions: Functions) -> bool:
        """Whether the compiled functions give what CasADi's interpreter gives, at one state.

        Compilers have faults: gcc 12 has been seen to drop the results of a model's linearisation.
        The state is the reference, at the point and θ of the memory, which stays as it is.
        """
        prepared, read = functions.preparation, functions.readout
        kept = prepared.memory.copy(), read.memory.copy()
        gradient = functions.derivatives[0]
        read.inputs["s"][:] = functions.problem.reference_state
        same = True
        if self.prepare() == 0:
            linear = slice(prepared.places["A"].start, prepared.places["r"].stop)
            compiled = prepared.memory[linear].copy()
            prepared()
            same = _alike(compiled, prepared.memory[linear])
        if same and self.prepare() == 0 and self.feedback(False) == 0:
            compiled = read.stack.copy()
            read()
            same = _alike(compiled, read.stack)
            for name in gradient.inputs:
                source = read if name in read.places else prepared
                gradient.inputs[name][:] = source.memory[source.places[name]]
            gradient()
            same = same and _alike(read.memory[read.places["gradient"]], gradient.stack)
        prepared.memory[:], read.memory[:] = kept
        return same

    def prepare(self) -> int:
        """Preparation phase at the point and θ that the memory holds."""
        return int(self._library.engine_prepare(*self._value[:2]))

    def feedback(self, enforced: bool) -> int:
        """Feedback phase for the memory's state, with `action` enforced or not."""
        given = self._action_value if enforced else self._value
        return int(self._library.engine_feedback(*given))

    def batch(self, *arrays: Vector | None) -> NDArray[np.intc]:
        """Run `engine_batch` on its arrays; statuses of the QPs (K,), −1: derivatives by Python."""
        assert arrays[0] is not None
        failed = np.empty(len(arrays[0]), dtype=np.intc)
        before, after = (memory.copy() for memory in self._memory)
        given = [None if a is None else ctypes.c_void_p(a.ctypes.data) for a in (*arrays, failed)]
        kept = (ctypes.c_void_p(memory.ctypes.data) for memory in (before, after))
        self._library.engine_batch(*kept, self._other, ctypes.c_longlong(len(failed)), *given)
        return failed

    def policy(self, before: Vector, after: Vector) -> tuple[Vector, Vector] | None:
        """dπ/dθ (m, n_θ) and dπ/ds (m, n); None if LICQ fails."""
        m, n_theta, n = self._sizes
        found: Vector = np.empty(m * (n_theta + n))
        at, of, to = (ctypes.c_void_p(array.ctypes.data) for array in (before, after, found))
        # Use another workspace: the next feedback needs the preparation's factors.
        if self._library.engine_policy(at, of, self._other, to):
            return None
        return found[: m * n_theta].reshape(m, n_theta), found[m * n_theta :].reshape(m, n)

    def begin(self) -> None:
        """Make ready for a closed loop: no earlier sample is known."""
        before, work, after, _ = self._value
        self._library.engine_begin(self._loop, before, after, work)

    def run(self, plant: Any, first: int, table: Vector) -> tuple[int, int, int]:
        """Run the plant, an instance's `native`, from sample `first` on; a row of `table` each.

        Returns the number of the sample that it came to, what failed there (0 where nothing did)
        and FMI's status. Other threads run meanwhile.
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

    `hessian` is `gauss-newton` or `exact`, `backend` `daqp`, `proxqp`, `qpsolvers:SOLVER`
    or a function that makes a `QpBackend`; `functions` says whether a sample is `interpreted` or
    `compiled` (see `compile`). Raises ControllerError on another choice.
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
        horizon, m = problem.horizon, problem.n_actions
        self._make_backend = partial(make_backend, backend) if isinstance(backend, str) else backend
        self._functions = made = Functions(problem, parameters.blocks, hessian)
        self._prepare, self._embed = made.preparation, made.embedding
        self._readout, self._hessian = made.readout, made.hessian
        before, after = self._prepare.memory, self._readout.memory
        self._qp = made.qp(before, after)
        self._bounds = self._scaled(problem.action_lower), self._scaled(problem.action_upper)
        self._qp.lower[:], self._qp.upper[:] = np.tile(self._bounds, horizon)
        self._engine: Engine | None = None
        self._prepared: Prepared | None = None
        self._weigh(problem.penalty_linear, problem.penalty_quadratic)
        self._x, self._u, self._costates = (
            made.preparation.part(name).reshape(horizon, -1) for name in LinearisationPoint._fields
        )
        self._constant = made.preparation.part("constant")
        # The point of linearisation and the read-out's next one, each in one piece: a shift copies.
        places = self._prepare.places
        self._point = before[places["x"].start : places["u"].stop]
        self._dense = places["H"].start, places["F"].stop
        places = self._readout.places
        self._next_point = slice(places["next_x"].start, places["next_u"].stop)
        self._next_costates, self._value = places["next_chi"], places["value"].start
        self._controls = slice(places["v"].start, places["v"].start + m)
        self._status = 0
        self.parameters = parameters
        self.functions = INTERPRETED
        self.reset()

    def compile(self, samples: int = LONG) -> None:
        """Compile for a run of `samples`, if it is long enough; call this before the first sample.

        COSIM_COMPILE=never forbids it, `now` compiles for any number. Without a compiler, for the
        exact Hessian and for backends other than `daqp` CasADi's interpreter stays. Both give the
        same to rounding and to DAQP's accuracy (`tests/controllers/rti/test_engine.py` holds the
        bounds).
        """
        if not self._compilable or (samples < LONG and switch() != "now") or switch() == "never":
            return
        reason = why_not_in_c(self._functions)
        if reason is not None:
            self._compilable = False
            warn(f"{reason}: the controller is not compiled, which is slower", ModelWarning)
            return
        engine = Engine.compile(self._functions)
        if engine is not None and not engine.agrees(self._functions):
            warn(
                "the C compiler makes other numbers of the model than CasADi does: the controller "
                "is not compiled, which is slower; set CC to another compiler",
                ModelWarning,
            )
            engine = None
        self._engine = engine
        self.functions = INTERPRETED if self._engine is None else COMPILED
        self._compilable = self._engine is not None  # where it failed once it is not tried again
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
        current = getattr(self, "_parameters", parameters)
        if parameters.blocks is not current.blocks and parameters.blocks != current.blocks:
            raise ParameterError(
                "θ has other blocks than the controller was built with: "
                f"{', '.join(parameters.blocks.slices)}; build a new controller for it"
            )
        parameters.require_well_posed()
        self._parameters = parameters
        self._hessian.set_parameters(parameters)
        self._prepare.inputs["theta"][:] = parameters.theta
        if "w_sigma" in parameters.blocks:
            self._weigh(parameters["w_sigma"], parameters["W_sigma"])
        self._prepared = None

    @property
    def theta(self) -> Vector:
        """θ as a flat read-only vector, (n_θ,); set it like `parameters`."""
        return self._parameters.theta

    @theta.setter
    def theta(self, theta: ArrayLike) -> None:
        self.parameters = self._parameters.with_theta(theta)

    # the two phases -----------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget all earlier samples: the next QP is linearised at the reference steady state."""
        self._x[:] = self.problem.reference_state
        self._u[:] = self.problem.reference_action
        self._costates[:] = 0.0
        self._pending: RtiSolution | None = None
        self._prepared = None
        self._backend = self._make_backend()

    def prepare(self) -> None:
        """Preparation phase: shift the last solution, linearise along it, condense, factorise.

        The shift drops the first stage, repeats the last control and, since stage N is not
        linearised, needs no state beyond the predicted x_N.
        """
        if self._pending is not None:
            memory, self._pending = self._pending.memory, None
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
            if array.shape != target.shape or not isfinite(sum(array.reshape(-1).tolist())):
                raise ControllerError(
                    f"linearisation point: {name} must be finite with shape {target.shape}, "
                    f"not {array.shape}"
                )
        self._pending = None
        self._linearise_at(LinearisationPoint(*arrays))

    def _linearise_at(self, point: LinearisationPoint) -> None:
        """Make a point the guess and linearise there."""
        self._x[:], self._u[:], self._costates[:] = point
        self._linearise()

    def _weigh(self, w: Vector, W: Vector) -> None:
        """Give the slack of the predicted stages its weights (n,), discounted."""
        horizon, n = self.problem.horizon, self.problem.n_states
        discounts = np.repeat(self.problem.discounts[1:], n)
        # Make new views: a backend recognises new weights by them.
        self._qp.w, self._qp.W = self._prepare.part("w"), self._prepare.part("W")
        price = self.problem.scale.state_price
        self._qp.w[:] = discounts * np.tile(w / price, horizon)
        self._qp.W[:] = discounts * np.tile(W * (self.problem.scale.state / price), horizon)

    def _scaled(self, action: Vector) -> Vector:
        """The QP's variables that stand for an action (m,)."""
        problem = self.problem
        return np.asarray((action - problem.reference_action) / problem.scale.action)

    def _linearise(self) -> None:
        prepare = self._prepare
        self._prepared = None
        if self._engine is not None:
            self._status = self._engine.prepare()
            finite = self._status != NOT_FINITE
        else:
            self._constant[0] = self._hessian.fill(self._x, self._u, self._costates)
            prepare()
            finite = prepare.finite()
        if not finite:
            raise self._failure(
                "the QP is not finite: the model has no finite value or derivative at the point of "
                "linearisation",
                "QP not finite",
            )
        if self._engine is None:
            self._backend.load(self._qp)
        if self._engine is not None and self._engine.stagewise:  # all but what was not condensed
            memory, first, last = np.empty_like(prepare.memory), *self._dense
            memory[:first], memory[last:] = prepare.memory[:first], prepare.memory[last:]
        else:
            memory = prepare.memory.copy()
        self._prepared = Prepared(memory, self._hessian.spectrum, self._functions, self._engine)

    def _failure(self, message: str, status: str) -> QpError:
        """An error with a copy of the QP, which compiled code may have left uncondensed."""
        self._prepare()
        self._embed()
        return QpError(message + self._hint(), status=status, qp=self._qp.copy())

    def _hint(self) -> str:
        """What may be the cause of a QP without a solution: a coarse integration."""
        integration = self._functions.integration
        return f"; the model is integrated coarsely: {integration.remedy}" * integration.coarse

    @property
    def linearisation_point(self) -> LinearisationPoint:
        """Point at which the QP is prepared, for replay by `prepare_at`."""
        if self._prepared is None:
            self.prepare()
        assert self._prepared is not None
        return self._prepared.point

    def feedback(self, s: ArrayLike, a: ArrayLike | None = None) -> RtiSolution:
        """Feedback phase: V(s) and π(s), or Q(s, a) where `a` is given.

        s (n,) and a (m,) in the units of the model; an enforced action replaces the bounds of the
        first control. The next `prepare` shifts this solution. Raises QpError where s is not finite
        or the QP is not solved; ControllerError on wrong shapes.
        """
        solution = self._solve(s, a)
        self._pending = solution
        return solution

    def _solve(self, s: ArrayLike, a: ArrayLike | None) -> RtiSolution:
        solution = self._solve_qp(s, a)
        if self.iterations > 1:
            prepared = self.linearisation_point
            try:
                for _ in range(self.iterations - 1):
                    self._linearise_at(solution.unshifted)
                    solution = self._solve_qp(s, a)
            finally:
                self._linearise_at(prepared)
        return solution

    def _solve_qp(self, s: ArrayLike, a: ArrayLike | None) -> RtiSolution:
        problem = self.problem
        s = _vector("state", s, problem.reference_state.size)
        if self._prepared is None:
            self.prepare()
        prepared = self._prepared
        assert prepared is not None
        self._readout.inputs["s"][:] = s
        if a is not None:
            a = _vector("action", a, problem.reference_action.size)
        solve = self._solve_interpreted if self._engine is None else self._solve_compiled
        try:
            finite = solve(s, a)
        except QpError as error:
            if self._engine is None:  # the backend knows nothing of the model
                error.args = (f"{error}{self._hint()}",)
            raise
        if not finite:
            message = f"the QP is not finite: state {s}, action {a!r}"
            raise self._failure(message, "state or action not finite")
        memory = self._readout.memory.copy()
        return RtiSolution(
            action=memory[self._controls] * problem.scale.action + problem.reference_action,
            value=float(memory[self._value]),
            prepared=prepared,
            memory=memory,
            enforced=a is not None,
        )

    def _solve_compiled(self, s: Vector, a: Vector | None) -> bool:
        """Solve; whether state and action are finite."""
        engine = self._engine
        assert engine is not None
        if a is not None:
            engine.action[:] = a
        status = self._status or engine.feedback(a is not None)
        if status not in (0, NOT_FINITE):
            raise self._failure(f"the QP was not solved: {STATUSES[status]}", STATUSES[status])
        return status == 0

    def _solve_interpreted(self, s: Vector, a: Vector | None) -> bool:
        qp, read, m = self._qp, self._readout, self._bounds[0].size
        self._embed()
        qp.lower[:m], qp.upper[:m] = self._bounds
        if a is not None:
            qp.lower[:m] = qp.upper[:m] = self._scaled(a)
        if not self._embed.finite() or not (a is None or all(map(isfinite, a.tolist()))):
            return False
        read.inputs["constant"][0] = self._constant[0]
        found = self._backend.solve(qp)
        residual = self._read(found, a is not None)
        if not residual <= ACCURATE:
            residual = self._read(polish(qp, found), a is not None)
        if not residual <= RESIDUAL:
            raise QpError(
                f"the QP was solved too inaccurately: its KKT residual is {residual:.1e}, more "
                f"than {RESIDUAL:g}; is the model unstable over so long a horizon?",
                status=INACCURATE,
                qp=qp.copy(),
            )
        return True

    def _read(self, found: QpSolution, enforced: bool) -> float:
        """Read a solution of the QP out; its residual."""
        if enforced:
            found = multipliers_at_kink(self._qp, found, *self._bounds)
        read = self._readout
        for name, values in found._asdict().items():
            read.inputs[name][:] = values
        read()
        return float(read.part("residual")[0])

    def compiled_loop(self, scenario: Scenario) -> CompiledLoop | None:
        """A new closed loop in compiled code; None if only Python can run it.

        That is before `compile`, with several iterations, in a subclass that samples otherwise, and
        where the scenario saturates otherwise than the problem.
        """
        own, problem = type(self), self.problem
        changed = (own.prepare, own.feedback) != (RtiNmpc.prepare, RtiNmpc.feedback)
        if self._engine is None or self.iterations > 1 or changed:
            return None
        for name in ("action_lower", "action_upper", "reference_action"):
            if not np.array_equal(getattr(scenario, name), getattr(problem, name)):
                return None
        if len(scenario.plant.states) != problem.n_states:
            return None
        self.reset()
        self._engine.begin()
        return self._engine.run

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
    ) -> tuple[Vector, ...]:
        """π (K, m) and V (K,) at states (K, n), or Q where actions (K, m) are enforced.

        With `derivatives` follow dV/ds (K, n), dV/dθ (K, n_θ), dQ/da (K, m), dπ/dθ (K, m, n_θ) and
        dπ/ds (K, m, n), zero where there is none. Where a QP is not solved π and V are NaN. θ, one
        or K, and points of linearisation, arrays of K rows, are the controller's own where they are
        not given; it keeps its own. Raises ControllerError on a wrong shape.
        """
        n, m, size = self.problem.n_states, self.problem.n_actions, self.theta.size
        if self._prepared is None:
            self.prepare()
        guess = self._x.copy(), self._u.copy(), self._costates.copy()
        if np.ndim(states) != 2:
            raise ControllerError(f"the states must have shape (K, {n}), not {np.shape(states)}")
        count = len(np.asarray(states))
        s = _rows("states", states, count, (n,))
        a = None if enforced is None else _rows("actions", enforced, count, (m,))
        thetas = _rows("θ", self.theta if theta is None else theta, count, (size,))
        pairs = zip(points or guess, guess, strict=True)
        each = [_rows("points", given, count, own.shape) for given, own in pairs]
        actions, values = np.full((count, m), np.nan), np.full(count, np.nan)
        slopes = np.zeros((count, n + size + m + m * (size + n))) if derivatives else None
        left = np.arange(count)
        if self._engine is not None and self.iterations == 1:
            failed = self._engine.batch(s, a, thetas, *each[:2], actions, values, slopes)
            left = np.flatnonzero(failed < 0)
        kept, pending = self._parameters, self._pending
        for k in left:
            with suppress(QpError, ParameterError):
                self.theta, self._pending = thetas[k], None
                self._linearise_at(LinearisationPoint(*(part[k] for part in each)))
                found = self._solve(s[k], None if a is None else a[k])
                actions[k], values[k] = found.action, found.value
                if slopes is not None:
                    own = found.costates[0], found.value_gradient, found.action_gradient
                    flat = np.concatenate(
                        [*own, *map(np.ravel, () if found.enforced else found._policy)]
                    )
                    slopes[k, : flat.size] = flat
        if len(left):
            self.parameters = kept
            self._linearise_at(LinearisationPoint(*guess))
            self._pending = pending
        if slopes is None:
            return actions, values
        *by, policy_theta, policy_s = np.split(slopes, np.cumsum([n, size, m, m * size]), axis=1)
        return actions, values, *by, policy_theta.reshape(-1, m, size), policy_s.reshape(-1, m, n)

    def action_value(self, s: ArrayLike, a: ArrayLike) -> float:
        """Q(s, a) of the prepared QP."""
        return self._solve(s, a).value

    def policy(self, s: ArrayLike) -> Vector:
        """π(s) of the prepared QP, (m,)."""
        return self._solve(s, None).action


def compile_functions(controller: object, samples: int = LONG) -> None:
    """Compile the controller if it is an `RtiNmpc`; do nothing for others."""
    if isinstance(controller, RtiNmpc) and controller.functions == INTERPRETED:
        controller.compile(samples)


def _alike(one: Vector, other: Vector) -> bool:
    """Whether two vectors are equal but for rounding, relative to the largest entry."""
    size = float(np.abs(other).max(initial=0.0))
    return bool(np.allclose(one, other, rtol=0.0, atol=1e-9 * size, equal_nan=True))


def _rows(kind: str, values: ArrayLike, count: int, shape: tuple[int, ...]) -> Vector:
    rows = np.asarray(values, dtype=np.float64)
    if rows.shape not in (shape, (count, *shape)):
        raise ControllerError(f"the {kind} must have shape {(count, *shape)}, not {rows.shape}")
    return np.ascontiguousarray(np.broadcast_to(rows, (count, *shape)))


def _vector(kind: str, values: ArrayLike, size: int) -> Vector:
    vector = np.asarray(values, dtype=np.float64)
    if vector.shape != (size,):
        raise ControllerError(f"the {kind} must have {size} entries, not shape {vector.shape}")
    return vector
