"""`cosim optimum` and `cosim tuning`: the best on a scenario, and the cost tuned towards it."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import cosim
from cosim.cli import output as cli

if TYPE_CHECKING:
    from controllers.dynamic_programming import Optimum, RoundProgress
    from controllers.dynamic_programming.periodic import PeriodicOptimum
    from controllers.optimum import QuasiStaticPolicy


def optimum(
    scenario: cli.ScenarioOption = "paper",
    refine: Annotated[bool, typer.Option("--refine")] = False,
    recompute: Annotated[bool, typer.Option("--recompute")] = False,
    json: cli.JsonOption = False,
) -> None:
    """Compute J*, the least possible mean cost per sample, by dynamic programming.

    The policy is stored and serves as the controller `optimal`. J* is certified if solution,
    refinement and long simulation agree within 0.05 %, and no policy search is below. Otherwise it
    is printed as a reference with its spread. With --refine the exit code is then 1.
    A plant that fouls or jumps has a quasi-static reference: J* of the plant at each time. One
    disturbance may have a memory: its value is then a state, and `optimal` is not available.

    Args:
        refine: Solve, refine the grid and simulate the policy; store the certificate.
        recompute: Solve even if the policy is stored.
    """
    with cli.output(json) as out_:
        from controllers.optimum import QuasiStaticPolicy, change_of
        from cosim.core.scenario import is_file

        task = cosim.Scenario.load(scenario)
        # Of a foreign FMU it is not known which instant its cost belongs to.
        if is_file(task.plant.fmu):
            out_.announce(task.plant.fmu)
            with cosim.FmuPlant(task) as plant:
                plant.require_cost_of_sample()
        if change_of(task) is not None and not task.signals:
            policy = QuasiStaticPolicy.from_scenario(task, progress=_show_rounds(out_))
            _show_quasi_static(policy, task, out_)
            return
        document = _solve(task, refine, recompute, out_)
        out_.json(document)
    # Without --refine nothing was asked that could be answered by no.
    if refine and document["objection"]:
        raise typer.Exit(1)


def _show_quasi_static(policy: QuasiStaticPolicy, task: cosim.Scenario, out_: cli.Output) -> None:
    """Print J* of the plant as it is, at each value of its drifting parameters."""
    drifting = policy.law.parameters
    names = list(drifting)
    table = []
    rows = []
    for position, gain in enumerate(policy.gains):
        row = {name: values[position] for name, values in drifting.items()}
        row["J"] = gain
        table.append(row)
        cells = [f"{value:.4f}" for value in row.values()]
        rows.append(cells)
    # The mean stands under the first parameter, the cells of the others stay empty.
    blanks = [""] * (len(names) - 1)
    rows.append(["mean", *blanks, f"{policy.gain:.4f}"])
    title = f"quasi-static reference of {task.name}: a reference, not a bound"
    out_.table(title, (*names, "J*"), rows)
    document = {
        "scenario": task.name,
        "kind": "reference",
        "J": policy.gain,
        "objection": f"quasi-static: J* along {', '.join(names)}(t), no bound",
        "table": table,
    }
    out_.json(document)


def _solve(task: cosim.Scenario, refine: bool, recompute: bool, out_: cli.Output) -> dict[str, Any]:
    """Solve or read the optimum, refine it if asked, print its tables; the JSON document."""
    if task.signals:
        return _solve_periodic(task, refine, recompute, out_)
    from controllers import optimum as store
    from controllers.dynamic_programming import Settings, certify, solve
    from controllers.problem import PlantProblem

    plant = PlantProblem.from_scenario(task)
    settings = Settings()
    key = store.optimum_key(plant, settings)
    path = None
    # A certificate belongs to the solution that it was made with.
    if not (refine or recompute):
        path = store.stored_file(key)
    show = _show_rounds(out_)
    if path is not None:
        solution = store.read_optimum(path, key)
    else:
        solution = solve(plant, settings, progress=show)
    if refine:
        solution = certify(plant, settings, solution, progress=show)
    if path is None:
        path = store.keep(key, solution)
    why_not = _objection(solution)
    # A memory that no controller sees outweighs any agreement of the figures.
    if plant.unseen:
        why_not = (
            f"its policy knows what {plant.unseen} was in the sample before, which no controller "
            "is told: a bound from below"
        )
    document = _show_solution(task, solution, path, why_not, out_)
    return document | {"edge_mass": solution.edge_mass}


def _solve_periodic(
    task: cosim.Scenario,
    refine: bool,
    recompute: bool,
    out_: cli.Output,
) -> dict[str, Any]:
    """The same of a scenario with signals; says first what it takes."""
    from controllers import periodic_optimum as store
    from controllers.dynamic_programming import Settings
    from controllers.dynamic_programming.periodic import certify_periodic, solve_periodic
    from controllers.optimum import stored_file

    periodic = store.periodic_plant(task)
    settings = Settings()
    key = store.periodic_key(periodic, settings)
    path = None if recompute else stored_file(key)
    if path is None or refine:
        minutes = store.expected_seconds(periodic, refine=refine) / 60
        out_.note(
            f"{task.name}: {periodic.period} phases of {task.sampling_time:g} s, about "
            f"{minutes:.0f} minutes on this machine as it is"
        )
    if path is None:
        solution = solve_periodic(periodic, settings, progress=out_.note)
        path = store.keep_periodic(key, periodic, solution)
    # What is stored is rounded: it is this policy that is certified and used.
    solution = store.read_periodic(path, key)
    if refine:
        solution = certify_periodic(periodic, settings, solution, progress=out_.note)
        path = store.keep_periodic(key, periodic, solution)
    document = _show_solution(
        task, solution, path, _objection(solution), out_, f" in {periodic.period} phases"
    )
    return document | {"phases": periodic.period}


def _objection(solution: Optimum | PeriodicOptimum) -> str | None:
    """Why the gain of a solution is not called J*; None where it is."""
    from controllers.dynamic_programming import objection

    if solution.certificate:
        return objection(solution.certificate)
    return "no certificate; make one with --refine"


def _show_solution(
    task: cosim.Scenario,
    solution: Optimum | PeriodicOptimum,
    path: Path,
    why_not: str | None,
    out_: cli.Output,
    phases: str = "",
) -> dict[str, Any]:
    """Print a solution's estimates of J*.

    Args:
        task: Its scenario.
        solution: The solution.
        path: Its file.
        why_not: Why its gain is not called J*; None where it is.
        out_: Where it is printed.
        phases: Words of the title behind the number of states.

    Returns:
        What the JSON document has of a solution of any kind.
    """
    from controllers.dynamic_programming import GainEstimate

    certificate = solution.certificate
    kind = "reference" if why_not else "optimum"
    own_gain = GainEstimate("solution", solution.gain, solution.lower, solution.upper)
    rows = []
    for name, *numbers in certificate or [own_gain]:
        cells = [f"{number:.4f}" for number in numbers]
        rows.append((name, *cells))
    sizes = [str(count) for count in solution.grid.shape]
    states = " × ".join(sizes)
    title = f"{kind} of {task.name}: J = {solution.gain:.4f} on {states} states{phases}"
    out_.table(title, ("", "J", "from", "to"), rows)
    if why_not is not None:
        out_.note(f"not called J*: {why_not}")
    return {
        "scenario": task.name,
        "kind": kind,
        "objection": why_not,
        "J": solution.gain,
        "lower": solution.lower,
        "upper": solution.upper,
        "file": str(path),
        "certificate": [figure._asdict() for figure in certificate] or None,
        "states": solution.grid.shape,
        "accuracy": asdict(solution.accuracy),
    }


def _show_rounds(out_: cli.Output) -> RoundProgress:
    """Note each round on a terminal: the grid and the closing bounds."""

    def show(level: int, number: int, solution: Optimum) -> None:
        """Print the round `number` on the grid `level`.

        Args:
            level: of the grid, from 0.
            number: of the round on it.
            solution: as far as it is.
        """
        if not out_.live:
            return
        where = f"grid {level} ({solution.grid.size} states), round {number}"
        out_.note(f"{where}: {solution.lower:.1f} ≤ J* ≤ {solution.upper:.1f}")

    return show


def tuning(
    scenario: cli.ScenarioOption = "paper",
    out: Annotated[Path | None, typer.Option("--out", "-o")] = None,
    json: cli.JsonOption = False,
) -> None:
    """Tune the NMPC's cost by economics (controller `tuned`), and print the result.

    The output has the optimal steady state, the price of each active bound, and the quadratic that
    was added to the cost, if any. With --json it has the certificate: eigenvalues of the Hessians
    and local feedback gains.

    Args:
        out: Write the tuned θ to this TOML file.
    """
    with cli.output(json) as out_:
        import numpy as np

        from controllers.economic import tune
        from controllers.factories import value_offset
        from controllers.problem import Problem
        from cosim.plant.fmi import unpack
        from cosim.plant.fmu_plant import refuse_bounds_elsewhere

        task = cosim.Scenario.load(scenario)
        # Bounds in another unit than the FMU's have no steady state.
        refuse_bounds_elsewhere(task, unpack(task.plant.fmu))
        problem = Problem.from_scenario(task)
        result = tune(problem)
        # The scenario says it, and no economics.
        offset = value_offset(task, problem)
        parameters = result.parameters.replace({"c_lambda": offset})
        steady = result.steady_state
        convex = result.convexification
        rows = []
        for line in str(result).splitlines():
            # Two blanks at least stand between the columns of the text.
            subject, _, words = line.partition("  ")
            rows.append((subject, words.strip()))
        out_.table(f"economic tuning of {scenario}", ("", "result"), rows)
        if out is not None:
            parameters.save(out)
            out_.note(f"θ {parameters.hash} is in {out.resolve()}")
        # Of all multipliers those of the active bounds.
        prices = (steady.C @ steady.multipliers).tolist()
        addition = None
        if result.addition is not None:
            addition = {
                "size": result.addition.size,
                "ranges": result.addition.ranges.tolist(),
                "released": list(result.addition.released),
                "reason": result.addition.reason,
                "meaning": str(result.addition),
            }
        steady_state = {
            "states": steady.x.tolist(),
            "actions": steady.u.tolist(),
            "cost": steady.cost,
        }
        document = {
            "scenario": scenario,
            "steady_state": steady_state,
            "active": dict(zip(steady.active, prices, strict=True)),
            "economic_eigenvalues": np.linalg.eigvalsh(steady.hessian).tolist(),
            "convexified_eigenvalues": np.linalg.eigvalsh(convex.hessian).tolist(),
            "alpha": convex.alpha,
            "beta": convex.beta,
            "force": convex.F.tolist(),
            "economic_gain": result.economic.tolist(),
            "gain_error": result.gain_error,
            "addition": addition,
            "parameters": parameters.hash,
        }
        out_.json(document)
