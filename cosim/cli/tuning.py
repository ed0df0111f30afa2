"""`cosim tuning`: the economic tuning of a scenario with its certificate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from cosim.cli.options import JsonOption, ScenarioOption
from cosim.cli.output import load_scenario, output


def tuning(
    scenario: ScenarioOption = "paper",
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Write the tuned θ to this TOML file.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Tune the NMPC's cost by economics (controller `tuned`) and show the certificate.

    It says which constraint enters, the eigenvalues of the economic and of the convexified
    cost's Hessian, and the local feedback gain of both.
    """
    with output(json) as out_:
        from controllers.economic import tune
        from controllers.factories import value_offset
        from controllers.problem import Problem

        loaded = load_scenario(scenario)
        problem = Problem.from_scenario(loaded)
        result = tune(problem, value_offset=value_offset(loaded, problem))
        steady, convex = result.steady_state, result.convexification
        document: dict[str, Any] = {
            "scenario": scenario,
            "steady_state": {
                "states": steady.x.tolist(),
                "actions": steady.u.tolist(),
                "cost": steady.cost,
            },
            "active": dict(
                zip(steady.active, (steady.C @ steady.multipliers).tolist(), strict=True)
            ),
            "economic_eigenvalues": steady.eigenvalues.tolist(),
            "convexified_eigenvalues": convex.eigenvalues.tolist(),
            "alpha": convex.alpha,
            "beta": convex.beta,
            "F": convex.F.tolist(),
            "delta_P": convex.delta_P.tolist(),
            "economic_gain": result.economic.gain.tolist(),
            "tuned_gain": result.tuned.gain.tolist(),
            "gain_error": result.gain_error,
            "parameters": result.parameters.hash,
        }
        rows = [tuple(line.split("  ", 1)) for line in str(result).splitlines()]
        out_.table(f"economic tuning of {scenario}", ("", "certificate"), rows)
        if out is not None:
            result.parameters.save(out)
            out_.note(f"θ {result.parameters.hash} is in {out.resolve()}")
        out_.json(document)
