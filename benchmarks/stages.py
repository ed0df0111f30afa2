"""`python -m benchmarks.stages`: our QP solver by stages beside HPIPM and Fatrop, same QPs.

The soft QPs are those of a closed loop at random states, many of them beyond a bound. Of ours the
whole sample counts, linearisation, solution and read-out; of the libraries, which CasADi's
`conic` calls, the solution alone. A QP counts as solved where the KKT residual of what comes back
is below what the controller accepts, whatever the solver says of itself. Fatrop's interface in
CasADi 3.8 prints the matrices at each call, which is in its time.
"""

import ctypes

import casadi as ca
import numpy as np

from benchmarks.measuring import clock
from controllers import Model, Parameters, Problem, Quantity, RtiNmpc
from controllers import functions as compilation
from controllers.export.core import controller_sources
from controllers.preparation import SOLVED_RESIDUAL, SampleFunctions
from cosim import Scenario

SAMPLES = 60
SAMPLE = """
#include "core.h"
size_t size(void) { return sizeof(RtiWork); }
int sample(RtiPrepared *prepared, RtiWork *work, RtiSolved *solved) {
    int status = rti_prepare(prepared);
    if (status == RTI_SOLVED) status = rti_load(prepared, work);
    return status == RTI_SOLVED ? rti_feedback(prepared, work, solved, 0) : status;
}
"""
LIBRARIES = {
    "hpipm": {
        "hpipm": {
            "mode": "speed",
            "iter_max": 50,
            "res_g_max": 1e-8,
            "res_b_max": 1e-8,
            "res_d_max": 1e-8,
            "res_m_max": 1e-8,
        }
    },
    "fatrop": {
        "structure_detection": "manual",
        "fatrop": {"tol": 1e-9, "print_level": 0},
    },
}


def chain(horizon, n=8, m=2):
    """Eight coupled states between two walls, two actions; an economic cost pulls at the walls."""
    coupling = np.diag(np.ones(n - 1), 1) + np.diag(np.ones(n - 1), -1) - 2.2 * np.eye(n)
    gain = np.zeros((n, m))
    gain[[2, 5], range(m)] = 1.0
    model = Model(
        name="chain",
        states=tuple(Quantity(f"x{i}", "1") for i in range(n)),
        actions=tuple(Quantity(f"u{i}", "1") for i in range(m)),
        disturbances=(),
        parameters=(),
        ode=lambda x, u, d, p: coupling @ x + 0.1 * ca.sin(x) + gain @ u,
        economic_cost=lambda x, u, d, p: 0.1 * ca.sumsqr(x) + ca.sumsqr(u) + 5 * ca.sum1(x),
    )
    return Problem(
        model=model,
        sampling_time=0.5,
        horizon=horizon,
        discount=0.99,
        state_lower=np.full(n, -1.0),
        state_upper=np.full(n, 1.0),
        action_lower=-np.ones(m),
        action_upper=np.ones(m),
        penalty_linear=np.full(n, 100.0),
        penalty_quadratic=np.full(n, 100.0),
        reference_state=np.zeros(n),
        reference_action=np.zeros(m),
        reference_cost=1.0,
    )


def evaporator(horizon):
    """The paper's problem, n = 2, with another horizon."""
    scenario = Scenario.load("paper").replace({"controller": {"horizon": horizon}})
    return Problem.from_scenario(scenario)


class StructuredQp:
    """The QP in the memory of a controller's functions, as a library for optimal control has it.

    The stages' variables are (ξ_k, v_k, t_{k+1}), so that the slack is one more control; each stage
    has the dynamics and two rows a state, x_l ≤ ξ_{k+1} + t and ξ_{k+1} − t ≤ x_u. The states are
    counted from those without controls, so that the dynamics have no offset: Fatrop's interface
    reads none.
    """

    def __init__(self, functions, name):
        problem = functions.problem
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        self.functions = functions
        self.width = n + m + n
        self.n, self.m, self.horizon = n, m, horizon
        H, A, *_ = self.data(np.random.default_rng(0).normal)
        options = {
            "N": horizon,
            "nx": [n] * (horizon + 1),
            "nu": [m + n] * horizon + [0],
            "ng": [2 * n] * horizon + [0],
            "print_time": False,
            "error_on_fail": False,
            **LIBRARIES[name],
        }
        shape = {name: ca.sparsify(ca.DM(M)).sparsity() for name, M in (("h", H), ("a", A))}
        self.H_pattern, self.A_pattern = shape["h"], shape["a"]
        self.solver = ca.conic("qp", name, shape, options)

    def data(self, numbers=None):
        """H, A, g and the limits; with `numbers` in the place of the memory's, for the pattern."""
        n, m, horizon, width = self.n, self.m, self.horizon, self.width
        prepare = self.functions.preparation
        problem = self.functions.problem

        def part(name, *shape):
            return numbers(size=shape) if numbers else prepare.part(name).reshape(shape)

        A = part("A", horizon, n, n)
        B = part("B", horizon, n, m)
        L = part("L", horizon, n + m, n + m)
        q = part("q", horizon, n + m)
        W = part("W", horizon, n)
        size = horizon * width + n
        hessian = np.zeros((size, size))
        gradient = np.zeros(size)
        rows = np.zeros((horizon * 3 * n, size))
        low = np.full(len(rows), -np.inf)
        high = np.full(len(rows), np.inf)
        parameters = Parameters(self.functions.blocks, prepare.part("theta"))
        x_s, scale = problem.reference_state, problem.scale.state
        x_l, x_u = ((parameters[name] - x_s) / scale for name in ("x_l", "x_u"))
        free = np.zeros(n)
        for k in range(horizon):
            first, row = k * width, k * 3 * n
            slack = slice(first + n + m, first + width)
            stage = slice(first, first + n + m)
            hessian[stage, stage] = L[k]
            hessian[slack, slack] = np.diag(2 * W[k])
            gradient[stage] = q[k] + L[k][:, :n] @ free
            free = A[k] @ free + part("r", horizon, n)[k]
            gradient[slack] = part("w", horizon, n)[k]
            dynamics = np.hstack([A[k], B[k]])
            rows[row : row + n, stage] = dynamics
            rows[row : row + n, first + width : first + width + n] = -np.eye(n)
            low[row : row + n] = high[row : row + n] = 0.0
            for j, sign in ((1, 1.0), (2, -1.0)):
                rows[row + j * n : row + (j + 1) * n, stage] = dynamics
                rows[row + j * n : row + (j + 1) * n, slack] = sign * np.eye(n)
            low[row + n : row + 2 * n] = x_l - free
            high[row + 2 * n : row + 3 * n] = x_u - free
        hessian[-n:, -n:] = part("L_N", n, n)
        gradient[-n:] = part("q_N", n) + part("L_N", n, n) @ free
        return hessian, rows, gradient, low, high

    def solve(self, s):
        """Processor seconds, the answer's KKT residual, how far its actions are from ours."""
        n, m, horizon, width = self.n, self.m, self.horizon, self.width
        problem = self.functions.problem
        hessian, rows, gradient, low, high = self.data()
        size = len(gradient)
        lower, upper = np.full(size, -np.inf), np.full(size, np.inf)
        x_s, scale = problem.reference_state, problem.scale
        lower[:n] = upper[:n] = (s - x_s) / scale.state
        for k in range(horizon):
            controls = slice(k * width + n, k * width + n + m)
            lower[controls] = (problem.action_lower - problem.reference_action) / scale.action
            upper[controls] = (problem.action_upper - problem.reference_action) / scale.action
            lower[k * width + n + m : (k + 1) * width] = 0.0
        given = {
            "h": ca.DM(self.H_pattern, hessian.T[tuple(reversed(self.H_pattern.get_triplet()))]),
            "a": ca.DM(self.A_pattern, rows[tuple(self.A_pattern.get_triplet())]),
            "g": gradient,
            "lba": low,
            "uba": high,
            "lbx": lower,
            "ubx": upper,
        }
        given = {name: ca.DM(value) for name, value in given.items()}
        begin = clock()
        answer = self.solver(**given)
        seconds = clock() - begin
        by_stage = answer["x"].full()[:-n, 0].reshape(horizon, width)
        bounds = answer["lam_x"].full()[:-n, 0].reshape(horizon, width)
        limits = answer["lam_a"].full()[:, 0].reshape(horizon, 3, n)
        read = self.functions.readout
        saved = read.memory.copy()
        read.inputs["s"][:] = s
        read.inputs["v"][:] = by_stage[:, n : n + m].reshape(-1)
        read.inputs["nu"][:] = bounds[:, n : n + m].reshape(-1)
        read.inputs["lam"][:] = (limits[:, 1] + limits[:, 2]).reshape(-1)
        read()
        residual = float(read.part("residual")[0])
        error = np.abs(read.part("v") - read.part("v", saved)).max()
        read.memory[:] = saved
        return seconds, residual, error


class CompiledSample:
    """Preparation and feedback in C, in the memory of the functions; no derivatives in θ."""

    def __init__(self, functions, stagewise):
        sources = controller_sources(functions, stagewise=stagewise) | {"sample.c": SAMPLE}
        path = compilation.library(sources)
        assert path is not None, "there is no C compiler, or it took too long"
        self.library = ctypes.CDLL(str(path))
        self.library.size.restype = ctypes.c_size_t
        work = np.zeros(self.library.size() // 8 + 1)
        arrays = functions.preparation.memory, work, functions.readout.memory
        self.arguments = [array.ctypes.data_as(ctypes.c_void_p) for array in arrays]

    def solve(self):
        """Processor seconds, and whether the QP was solved."""
        begin = clock()
        status = self.library.sample(*self.arguments)
        return clock() - begin, status == 0


def measure(problem):
    """Print medians of processor time, the ratios to ours, and how many QPs each solver solves."""
    controller = RtiNmpc(problem, Parameters.naive(problem))  # it writes θ and the weights
    functions = SampleFunctions(problem, controller.parameters.blocks, "gauss-newton")
    functions.preparation.memory[:] = controller._prepare.memory
    samples = {"stages": CompiledSample(functions, stagewise=True)}
    if problem.n_states * problem.horizon <= 80:  # a compiler takes minutes for larger ones
        samples["condensed"] = CompiledSample(functions, stagewise=False)
    libraries = {name: StructuredQp(functions, name) for name in LIBRARIES if ca.has_conic(name)}
    rng = np.random.default_rng(0)
    width = np.minimum(problem.state_upper - problem.state_lower, 50.0)
    prepare, read = functions.preparation, functions.readout
    read.inputs["lower"][:] = controller._qp.lower
    read.inputs["upper"][:] = controller._qp.upper
    times = {name: [] for name in (*samples, *libraries)}
    residuals = {name: [] for name in times}
    errors = {name: [0.0] for name in times}

    for _ in range(SAMPLES):
        s = problem.reference_state + 0.2 * width * rng.standard_normal(problem.n_states)
        read.inputs["s"][:] = s
        for name in reversed(samples):  # the last one's solution is what the libraries compare with
            seconds, solved = samples[name].solve()
            times[name].append(seconds)
            residuals[name].append(float(read.part("residual")[0]) if solved else np.inf)
        for name, qp in libraries.items():
            seconds, residual, error = qp.solve(s)
            times[name].append(seconds)
            errors[name].append(error)
            residuals[name].append(residual)
        if np.isfinite(residuals["stages"][-1]):
            for target, source in (("x", "next_x"), ("u", "next_u"), ("costates", "next_chi")):
                prepare.part(target)[:] = read.part(source)

    own = np.median(times["stages"])
    n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
    for name, seconds in times.items():
        measured = np.nan_to_num(residuals[name], nan=np.inf)
        solved = (measured <= SOLVED_RESIDUAL).sum()
        print(
            f"n = {n}, m = {m}, N = {horizon}, {name:9}: {1e6 * np.median(seconds):8.0f} µs, "
            f"{np.median(seconds) / own:6.2f} × stages, solves {solved} of {SAMPLES}, "
            f"residual median {np.median(measured):.0e}, largest {measured.max():.0e}, "
            f"actions off by {max(errors[name]):.0e}"
        )


def main():
    compilation.PATIENCE = 900.0
    for problem in (evaporator(40), evaporator(80), chain(40)):
        measure(problem)


if __name__ == "__main__":
    main()
