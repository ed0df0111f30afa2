"""`cosim shadow`: what a controller would have done on logged data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import cosim
from cosim.cli import logged_data
from cosim.cli import output as cli


def shadow(
    controller: str,
    data: Annotated[Path, typer.Option("--data")],
    scenario: cli.ScenarioOption = "paper",
    columns: logged_data.ColumnsOption = None,
    leave_out: logged_data.LeaveOutOption = None,
    out: cli.OutOption = Path("cosim-shadow"),
    record: cli.RecordOption = False,
    overwrite: cli.OverwriteOption = False,
    json: cli.JsonOption = False,
) -> None:
    """Show the actions that a controller would have applied to logged data.

    Writes shadow.csv, shadow.png (of up to 20 000 rows), summary.json, scenario.toml and, with
    --record, shadow.rrd. No plant is stepped: the controller gets the measurements, and
    its actions are drawn beside the logged ones.

    Args:
        controller: naive, tuned, backed-off, cautious, lqr, pi, converged, optimal, a parameters
            file, or module:factory.
        data: CSV file of logged data.
    """
    with cli.output(json) as out_:
        from controllers.problem import Problem
        from cosim.core.files import staged
        from cosim.core.logged_data import read_log
        from cosim.core.run_files import RUN_FILES
        from cosim.shadow import given_names, shadow
        from learning.from_data import doubts_of

        loaded = cosim.Scenario.load(scenario)
        law = cosim.build_controller(controller, loaded)
        # Without a model nothing but the FMU knows the units, and that is not opened.
        units = (
            Problem.from_scenario(loaded).model.variable_units if loaded.controller.model else {}
        )
        table = read_log(
            data,
            loaded,
            columns=logged_data.columns_by_name(columns),
            units=units,
            leave_out=leave_out or (),
            given=given_names(law, loaded),
        )
        folder = cli.open_folder(out, overwrite)
        result = shadow(law, table, loaded)
        doubts = []
        if loaded.controller.model and result.given_names == loaded.plant.states:
            doubts = doubts_of(table, loaded)
        summary = result.summary() | {"doubts": doubts}
        with staged(folder, RUN_FILES) as stage:
            result.write_csv(stage / "shadow.csv")
            if 1 < len(result) <= cli.MOST_DRAWN:
                result.plot(stage / "shadow.png")
            if record:
                from cosim.recording import record_overlay

                about = f"# {controller} in the shadow of {data.name}"
                record_overlay(stage / "shadow.rrd", result.runs(), about)
            (stage / "scenario.toml").write_text(loaded.to_toml(), "utf-8")
            cli.write_summary(stage, summary)
        rows = []
        for name, action in summary["actions"].items():
            rows.append(
                (
                    name,
                    f"{action['mean_difference']:.4g}",
                    f"{action['mean_distance']:.4g}",
                    f"{action['largest_distance']:.4g}",
                    f"{action['largest_at']:g}",
                    f"{100 * action['share_at_bound']:.1f}",
                    f"{100 * action['logged_share_at_bound']:.1f}",
                )
            )
        header = (
            "input",
            "mean difference",
            "mean distance",
            "largest distance",
            "at s",
            "at a bound %",
            "logged at a bound %",
        )
        title = (
            f"{controller} in the shadow of {data.name}: {summary['samples']} of "
            f"{summary['rows']} rows, {summary['failures']} failures"
        )
        out_.table(title, header, rows)
        for reason, count in summary["left_out"].items():
            out_.note(f"left out: {count} × {reason}")
        for doubt in doubts:
            out_.note(f"in doubt, as `cosim train --data` has it: {doubt}")
        out_.note(f"files are in {out.resolve()}")
        out_.json(summary)
