"""Our sample beside acados' real-time iteration on the same problem, turn by turn in one run.

acados comes from an environment of its own, which `--against` names by its Python:

    python3 -m venv acados
    acados/bin/pip install comma-deps-acados platformdirs daqp tomli_w pydantic
    python -m benchmarks acados --against acados/bin/python

That package has a CasADi of its own, and acados 0.2.2, whose solver differentiates its solution in
the initial state alone: without dV/dθ and dπ/dθ it has less to do than ours. Its worker reads the
problem from this checkout: the same model by the same Runge–Kutta steps, costs, bounds, penalties.
Of acados only its own calls are timed, not what its Python interface needs to set and get; of ours
all, shift and Python included. HPIPM is in its fast mode, which gives the actions to 1e-4.
"""

import ctypes
import os
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from time import perf_counter

import numpy as np

REPETITIONS = 20
KINDS = {
    "value": "prepare + feedback + dV/dθ",
    "policy": "prepare + feedback + dV/dθ + dπ/ds + dπ/dθ",
}
BOUNDS = {"value": 1 / 0.25, "policy": None}
TREE = Path(__file__).resolve().parents[1]


def measure(scenario, steps, against):
    """Wall time of `steps` samples; AssertionError where the actions differ by more than 1e-4."""
    from benchmarks.measuring import figure
    from controllers.factories import tuned

    controller = tuned(scenario)
    controller.compile()
    states = controller.problem.reference_state + np.array([0.3, 1.0]) * np.random.default_rng(
        0
    ).normal(size=(steps, 2))
    seconds = {kind: {"own": [], "alone": [], "differentiated": []} for kind in KINDS}
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        np.savez(folder / "given.npz", states=states, theta=controller.theta)
        process = stack.enter_context(
            subprocess.Popen(
                [against, "-P", __file__, scenario.name], cwd=folder, text=True,
                env=os.environ | {"PYTHONPATH": str(TREE)},
                stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            )
        )  # fmt: skip
        for turn in range(REPETITIONS + 1):
            for kind, times in seconds.items():
                own, actions = samples(controller, states, kind)
                found = {"own": own}
                for what in ("alone", "differentiated"):
                    print(what, file=process.stdin, flush=True)
                    found[what] = float(process.stdout.readline())
                if turn:  # the first one warms up
                    for what, spent in found.items():
                        times[what].append(spent / steps)
        process.stdin.close()
        process.wait()
        error = np.abs(np.load(folder / "actions.npy") - actions).max()
    assert error < 1e-4, f"the actions differ by {error:.1e}: it is not the same problem"
    return [
        figure(KINDS[kind], times["own"], name, times[what], at_least=bound)
        for kind, times in seconds.items()
        for what, name, bound in (
            ("alone", "acados: preparation, feedback", None),
            ("differentiated", "acados: preparation, feedback, dπ/ds", BOUNDS[kind]),
        )
    ]


def samples(controller, states, kind):
    """Seconds of a sample for each state, and the actions (K, m)."""
    actions = []
    controller.reset()
    begin = perf_counter()
    for s in states:
        controller.prepare()
        solution = controller.feedback(s)
        solution.value_gradient  # noqa: B018
        if kind == "policy":
            solution.policy_jacobian  # noqa: B018
        actions.append(solution.action)
    return perf_counter() - begin, np.array(actions)


def solver(scenario, theta):
    """acados' solver of the scenario's problem; θ is its parameter."""
    import acados
    import casadi as ca

    os.environ["ACADOS_SOURCE_DIR"] = acados.DIR
    os.environ["ACADOS_PYTHON_INTERFACE_PATH"] = acados.TEMPLATE_DIR
    for name in ("libblasfeo.so", "libhpipm.so", "libqpOASES_e.so.3.1"):
        ctypes.CDLL(f"{acados.LIB_DIR}/{name}", ctypes.RTLD_GLOBAL)
    from acados.acados_template import AcadosModel, AcadosOcp, AcadosOcpSolver

    from controllers.model import discretise
    from controllers.problem import Problem
    from controllers.theta import Parameters, ThetaBlocks, symbolic_theta

    problem = Problem.from_scenario(scenario)
    blocks = ThetaBlocks.from_problem(problem)
    parameters = Parameters.naive(problem, blocks).with_theta(theta)
    n, m, horizon, gamma = problem.n_states, problem.n_actions, problem.horizon, problem.discount
    symbols = symbolic_theta(problem, blocks)
    x, u, discount = ca.SX.sym("x", n), ca.SX.sym("u", m), ca.SX.sym("discount")
    f = discretise(problem.model, problem.sampling_time, problem.substeps)
    x_s, u_s = ca.DM(problem.reference_state), ca.DM(problem.reference_action)
    w, end = ca.vertcat(x - x_s, u - u_s), x - x_s
    ocp, model = AcadosOcp(), AcadosModel()
    model.name, model.x, model.u = "controller", x, u
    model.p = ca.vertcat(symbols["theta"], discount)
    model.disc_dyn_expr = (
        f(x, u, problem.model.nominal_disturbance, symbols["model_parameters"]) + symbols["c_f"]
    )
    model.cost_expr_ext_cost = discount * (ca.bilin(symbols["B_l"], w) + ca.dot(symbols["b_l"], w))
    model.cost_expr_ext_cost_e = discount * (
        ca.bilin(symbols["B_Vf"], end) + ca.dot(symbols["b_Vf"], end)
    )
    ocp.model, ocp.dims.N = model, horizon
    ocp.cost.cost_type = ocp.cost.cost_type_e = "EXTERNAL"
    ocp.parameter_values = np.append(parameters.theta, 1.0)
    constraints, options = ocp.constraints, ocp.solver_options
    constraints.x0 = problem.reference_state
    constraints.idxbu = np.arange(m)
    constraints.lbu, constraints.ubu = problem.action_lower, problem.action_upper
    weights = problem.penalty_linear, 2 * problem.penalty_quadratic
    for suffix in ("", "_e"):
        for name in (f"idxbx{suffix}", f"idxsbx{suffix}"):
            setattr(constraints, name, np.arange(n))
        setattr(constraints, f"lbx{suffix}", parameters["x_l"])
        setattr(constraints, f"ubx{suffix}", parameters["x_u"])
        for name, values in zip("zZ", weights, strict=True):
            for side in "lu":
                setattr(ocp.cost, f"{name}{side}{suffix}", values)
    options.nlp_solver_type, options.qp_solver = "SQP_RTI", "PARTIAL_CONDENSING_HPIPM"
    options.qp_solver_cond_N, options.hpipm_mode = horizon // 2, "SPEED"
    options.integrator_type, options.hessian_approx = "DISCRETE", "EXACT"
    options.exact_hess_dyn = options.exact_hess_constr = 0
    options.tf = float(horizon)
    options.ext_fun_compile_flags = "-O2"
    found = AcadosOcpSolver(ocp, json_file="controller.json", verbose=False)
    for k in range(horizon + 1):
        found.set(k, "p", np.append(parameters.theta, gamma**k))
        for name, values in zip("zZ", weights, strict=True):
            for side in "lu" if k else "":
                found.cost_set(k, f"{name}{side}", gamma**k * values)
    return problem, found


def worker(name):
    """Answer each line `alone` or `differentiated` by the seconds of a pass over the states."""
    from cosim.core.scenario import Scenario

    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)  # acados and make print
        given = np.load("given.npz")
        problem, found = solver(Scenario.load(name), given["theta"])
        horizon = problem.horizon
        for line in sys.stdin:
            x = np.tile(problem.reference_state, (horizon + 1, 1))
            u = np.tile(problem.reference_action, (horizon, 1))
            actions, spent = [], 0.0
            for s in given["states"]:
                for k in range(horizon):
                    found.set(k, "x", x[k])
                    found.set(k, "u", u[k])
                found.set(horizon, "x", x[horizon])
                found.options_set("rti_phase", 1)
                begin = perf_counter()
                found.solve()
                spent += perf_counter() - begin
                found.set(0, "lbx", s)
                found.set(0, "ubx", s)
                found.options_set("rti_phase", 2)
                begin = perf_counter()
                status = found.solve()
                if line.strip() == "differentiated":
                    for i in range(problem.n_states):
                        found.eval_param_sens(i)
                spent += perf_counter() - begin
                actions.append(found.get(0, "u"))
                assert status == 0, f"acados did not solve the QP: {status}"
                x[:-1] = [found.get(k + 1, "x") for k in range(horizon)]
                x[-1] = x[-2]
                u[:-1] = [found.get(k + 1, "u") for k in range(horizon - 1)]
                u[-1] = u[-2]
            np.save("actions.npy", np.array(actions))
            print(spent, file=answers, flush=True)


if __name__ == "__main__":
    worker(sys.argv[1])
