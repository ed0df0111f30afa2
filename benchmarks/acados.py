"""`python -m benchmarks.acados N_STATES,HORIZON …`: our sample beside acados' real-time iteration.

Tanks in series with two pumps, both solvers on the same states in one process, in turns. It prints
a row of a table for each case: our time of a sample with all derivatives, its ratio to acados'
by configuration for each of `PARTS`, and how far actions, dV/dθ and dπ/dθ lie apart, over the
largest entry of ours. Ours are those of finite differences (`tests/controllers/`).

acados 0.6 and its Python package `acados_template` are built from their sources:

    cmake -DACADOS_WITH_DAQP=ON -DCMAKE_C_FLAGS="-O3 -march=native" -DACADOS_INSTALL_DIR=FOLDER …
    make install
    pip install FOLDER/interfaces/acados_template

`ACADOS_SOURCE_DIR` names the folder, `LD_LIBRARY_PATH` its `lib`; `bin` has `t_renderer`.

Version 0.6.0 needs a mend: its template `acados_solver.in.h` declares
`nl_constr_h_hess_ux_pdiff_adj_pdiff` twice, where the second is `nl_constr_h_e_…`.

Of acados only solver and sensitivity calls are timed, of ours all, shift and Python included.
HPIPM solves to 1e-9: at its default its derivatives of a nearly active bound are too far off.
"""

import ctypes
import sys
import tempfile
from pathlib import Path
from statistics import median

import casadi as ca
import numpy as np

from benchmarks.measuring import clock
from benchmarks.paths import tanks_in_series
from controllers import Parameters, RtiNmpc, ThetaBlocks, compile_functions
from controllers.model import discretise
from controllers.theta import symbolic_theta

SAMPLES = 20
REPETITIONS = 5
FLAGS = "-O3 -march=native"
TOLERANCE = 1e-3
"""Of the largest entry, by which actions may differ: more is another problem."""
PARTS = ("prepare + feedback", "with dV/dθ", "with dV/dθ, dπ/ds and dπ/dθ")
COMPARED = ("B_Vf", "b_Vf", "B_l", "b_l", "c_f", "x_l", "x_u")
"""Blocks of θ of which acados has derivatives; λ's is no part of its problem."""


def measure(n, horizon):
    """Print the row of `n` tanks and `horizon` stages."""
    problem = tanks_in_series(n, horizon)
    controller = RtiNmpc(problem, Parameters.naive(problem))
    compile_functions(controller)
    noise = np.random.default_rng(0).standard_normal((SAMPLES, n))
    states = problem.reference_state + 0.02 * noise
    others = {
        "N/2 blocks": Acados(problem, horizon // 2),
        "not condensed": Acados(problem, horizon),
    }
    spent = {name: [] for name in ("ours", *others)}
    errors = np.zeros(3)
    for turn in range(REPETITIONS + 1):
        seconds, results, regular = pass_of_ours(controller, states)
        passes = {"ours": seconds}
        for name, other in others.items():
            passes[name], found = other.walk(states)
            errors = np.maximum(errors, typical_differences(results, found, regular))
        if turn:  # the first one warms up
            for name, seconds in passes.items():
                spent[name].append(np.array(seconds) / SAMPLES)
    assert errors[0] < TOLERANCE, f"the actions differ by {errors[0]:.1e}: it is another problem"
    cells = [f"{n}, {horizon}", f"{1e6 * median(times[-1] for times in spent['ours']):.0f}"]
    for name in others:
        for part in range(len(PARTS)):
            pairs = zip(spent["ours"], spent[name], strict=True)
            cells.append(f"{median(own[part] / other[part] for own, other in pairs):.2f}")
    cells += [f"{error:.0e}" for error in errors]
    cells.append(f"{regular.sum()} of {SAMPLES}")
    print("| " + " | ".join(cells) + " |", flush=True)


def typical_differences(ours, others, regular):
    """Of actions, dV/dθ and dπ/dθ, each (K, …), over the largest entry of ours: the median sample.

    Only samples that are `regular` count: in others the multipliers are not unique.

    Where the active set is about to change, an interior point gives derivatives between both sides.
    """
    typical = []
    for own, other in zip(ours, others, strict=True):
        away = np.abs(other - own).reshape(len(own), -1).max(axis=1)[regular]
        typical.append(np.median(away) / np.abs(own).max())
    return np.array(typical)


def pass_of_ours(controller, states):
    """Seconds of a pass over the states (K, n) up to each of `PARTS`, and its results."""
    actions, gradients, jacobians, regular = [], [], [], []
    blocks = controller.parameters.blocks
    compared = np.concatenate([np.arange(blocks.size)[blocks.slices[name]] for name in COMPARED])
    seconds = np.zeros(3)
    controller.reset()
    for s in states:
        begin = clock()
        controller.prepare()
        solution = controller.feedback(s)
        solved = clock()
        gradient = solution.value_gradient
        with_gradient = clock()
        jacobian = solution.policy_jacobian
        end = clock()
        seconds += (solved - begin, with_gradient - begin, end - begin)
        actions.append(solution.action)
        gradients.append(gradient[compared])
        jacobians.append(jacobian[:, compared])
        regular.append(solution.licq and not solution.weakly_active)
    results = (np.array(actions), np.array(gradients), np.array(jacobians))
    return seconds, results, np.array(regular)


def soften(ocp, problem):
    """Make the bounds h ≥ 0 of acados' problem soft, at the prices of ours."""
    n = problem.n_states
    linear = np.tile(problem.penalty_linear, 2)
    quadratic = 2 * np.tile(problem.penalty_quadratic, 2)
    for suffix in ("", "_e"):
        setattr(ocp.constraints, f"lh{suffix}", np.zeros(2 * n))
        setattr(ocp.constraints, f"uh{suffix}", np.full(2 * n, 1e10))
        setattr(ocp.constraints, f"idxsh{suffix}", np.arange(2 * n))
        for side in "lu":
            setattr(ocp.cost, f"z{side}{suffix}", linear)
            setattr(ocp.cost, f"Z{side}{suffix}", quadratic)


class Acados:
    """acados' SQP-RTI of a problem, with the bounds of states as constraints h(x, θ)."""

    def __init__(self, problem, blocks):
        """Build it: `blocks` stages remain of HPIPM's partial condensing."""
        from acados_template import AcadosOcp, AcadosOcpSolver

        self.problem = problem
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        theta_blocks = ThetaBlocks.from_problem(problem)
        theta = Parameters.naive(problem, theta_blocks).theta
        symbols = symbolic_theta(problem, theta_blocks)
        x, u = ca.SX.sym("x", n), ca.SX.sym("u", m)
        f = discretise(problem.model, problem.sampling_time, problem.substeps)
        end = x - ca.DM(problem.reference_state)
        w = ca.vertcat(end, u - ca.DM(problem.reference_action))
        ocp = AcadosOcp()
        model = ocp.model
        model.name = f"tanks_{n}_{horizon}_{blocks}"
        model.x, model.u, model.p_global = x, u, symbols["theta"]
        disturbance = problem.model.nominal_disturbance
        step = f(x, u, disturbance, symbols["model_parameters"])
        model.disc_dyn_expr = step + symbols["c_f"]
        model.cost_expr_ext_cost = ca.bilin(symbols["B_l"], w) + ca.dot(symbols["b_l"], w)
        model.cost_expr_ext_cost_e = ca.bilin(symbols["B_Vf"], end) + ca.dot(symbols["b_Vf"], end)
        room = ca.vertcat(x - symbols["x_l"], symbols["x_u"] - x)
        model.con_h_expr = model.con_h_expr_e = room
        ocp.cost.cost_type = ocp.cost.cost_type_e = "EXTERNAL"
        ocp.p_global_values = theta
        constraints = ocp.constraints
        constraints.x0 = problem.reference_state
        constraints.idxbu = np.arange(m)
        constraints.lbu, constraints.ubu = problem.action_lower, problem.action_upper
        soften(ocp, problem)
        options = ocp.solver_options
        options.N_horizon, options.tf = horizon, float(horizon)
        options.nlp_solver_type, options.qp_solver = "SQP_RTI", "PARTIAL_CONDENSING_HPIPM"
        options.qp_solver_cond_N, options.hpipm_mode = blocks, "SPEED"
        options.qp_tol = 1e-9
        options.integrator_type, options.hessian_approx = "DISCRETE", "EXACT"
        options.exact_hess_dyn = options.exact_hess_constr = 0
        options.cost_scaling = problem.discount ** np.arange(horizon + 1)
        ocp.code_gen_options.with_value_sens_wrt_params = True
        ocp.code_gen_options.with_solution_sens_wrt_params = True
        ocp.code_gen_options.ext_fun_compile_flags = FLAGS
        self.folder = tempfile.TemporaryDirectory()
        ocp.code_gen_options.code_export_directory = str(Path(self.folder.name, "code"))
        self.solver = AcadosOcpSolver(ocp, verbose=False)
        self.library = self.solver._AcadosOcpSolver__acados_lib
        self.gradient = np.zeros(theta.size)
        slices = [np.arange(theta.size)[theta_blocks.slices[name]] for name in COMPARED]
        self.compared = np.concatenate(slices)

    def walk(self, states):
        """Seconds of acados' own calls over the states (K, n), and the actions (K, m)."""
        problem, found, library = self.problem, self.solver, self.library
        n, m, horizon = problem.n_states, problem.n_actions, problem.horizon
        x = np.tile(problem.reference_state, (horizon + 1, 1))
        u = np.tile(problem.reference_action, (horizon, 1))
        out = ctypes.cast(self.gradient.ctypes.data, ctypes.POINTER(ctypes.c_double))
        size = self.gradient.size
        actions, gradients, jacobians = [], [], []
        spent = np.zeros(3)
        for s in states:
            for k in range(horizon):
                found.set(k, "x", x[k])
                found.set(k, "u", u[k])
            found.set(horizon, "x", x[horizon])
            found.options_set("rti_phase", 1)
            begin = clock()
            found.solve()
            preparation = clock() - begin
            found.set(0, "lbx", s)
            found.set(0, "ubx", s)
            found.options_set("rti_phase", 2)
            begin = clock()
            status = found.solve()
            solved = clock() - begin
            assert status == 0, f"acados did not solve the QP: {status}"
            begin = clock()
            library.ocp_nlp_eval_lagrange_grad_p(found.nlp_solver, found.nlp_in, b"p_global", out)
            gradient = clock() - begin
            gradients.append(self.gradient[self.compared])
            begin = clock()
            for i in range(n):
                library.ocp_nlp_eval_param_sens(found.nlp_solver, b"ex", 0, i, found.sens_out)
            slopes = clock() - begin
            rows = np.zeros((m, size))
            for i in range(m):
                found.reset_sens_out()
                found.set(0, "sens_u", np.eye(m)[i])
                begin = clock()
                library.ocp_nlp_eval_solution_sens_adj_p(
                    found.nlp_solver, found.nlp_in, found.sens_out, b"p_global", 0, out
                )
                slopes += clock() - begin
                rows[i] = self.gradient
            jacobians.append(rows[:, self.compared])
            solved += preparation
            spent += (solved, solved + gradient, solved + gradient + slopes)
            actions.append(found.get(0, "u"))
            x[:-1] = [found.get(k + 1, "x") for k in range(horizon)]
            x[-1] = x[-2]
            u[:-1] = [found.get(k + 1, "u") for k in range(horizon - 1)]
            u[-1] = u[-2]
        return spent, (np.array(actions), np.array(gradients), np.array(jacobians))


if __name__ == "__main__":
    print(
        "n, N; ours in µs; ÷ acados with N/2 blocks, then not condensed, each by part; differences"
    )
    for word in sys.argv[1:]:
        measure(*(int(number) for number in word.split(",")))
