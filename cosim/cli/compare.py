"""`cosim compare`: two runs side by side."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.output import JsonOption, output
from cosim.core.errors import ComparisonError
from cosim.core.files import protect


def compare(
    a: Path,
    b: Path,
    tolerance: Annotated[list[str] | None, typer.Option("--tolerance", "-t")] = None,
    relative: Annotated[float, typer.Option(min=0.0)] = 0.0,
    record: Path | None = None,
    json: JsonOption = False,
) -> None:
    """Compare two runs sample by sample; exit code 1 if they differ.

    Without tolerances every bit of every signal counts; wall-clock times never do.

    Args:
        a: Run: its folder, trajectory.csv or .rrd.
        b: Run to compare it with.
        tolerance: NAME=VALUE in the signal's unit; repeatable.
        relative: Tolerance of the others, per largest magnitude in A; the residual is left out.
        record: Write a Rerun recording with both overlaid.
    """
    with output(json) as out_:
        from cosim import comparison

        runs = comparison.load_run(a), comparison.load_run(b)
        protect(run.name for run in runs)  # of a folder, the file in it
        result = comparison.compare(
            *runs, dict(map(_read_tolerance, tolerance or [])), relative=relative
        )
        differences = result.lines() or ["no signal differs by more than its tolerance"]
        if record is not None:
            from cosim.recording import record_overlay

            about = "\n".join(["# A against B", "", *(f"- {text}" for text in differences)])
            overlaid = {f"A: {runs[0].label}": runs[0], f"B: {runs[1].label}": runs[1]}
            record_overlay(record, overlaid, about)
            out_.note(f"both runs are overlaid in {record.resolve()}")
        rows = [
            (
                d.name,
                d.unit,
                f"{d.maximum:.6g}",
                str(d.at) if d.maximum > 0 else "",
                "every bit" if d.tolerance is None else f"{d.tolerance:.6g}",
                "" if d.first is None else str(d.first),
            )
            for d in result.differences
        ]
        header = ("signal", "unit", "largest difference", "at sample", "tolerance", "first beyond")
        out_.table(f"{a} against {b}, {min(result.samples)} samples", header, rows)
        out_.note("\n".join(differences))
        out_.json(result.document())
    if not result.equal:
        raise typer.Exit(1)


def _read_tolerance(option: str) -> tuple[str, float]:
    """Signal and tolerance of an option NAME=VALUE."""
    name, _, value = option.rpartition("=")
    try:
        return name, float(value)
    except ValueError:
        text = f"--tolerance {option}: give NAME=VALUE, e.g. X2=1e-9"
        raise ComparisonError(text) from None
