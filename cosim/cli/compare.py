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
        relative: Tolerance of the other signals, as a share of the largest magnitude in A; the
            residual is not compared.
        record: Write a Rerun recording with both overlaid.
    """
    with output(json) as out_:
        from cosim import comparison

        first = comparison.load_run(a)
        second = comparison.load_run(b)
        # Of a folder the command line knows only the folder, not the file in it.
        protect([first.name, second.name])
        tolerances = {}
        for option in tolerance or []:
            name, value = _read_tolerance(option)
            tolerances[name] = value
        result = comparison.compare(first, second, tolerances, relative=relative)
        differences = result.lines() or ["no signal differs by more than its tolerance"]
        if record is not None:
            from cosim.recording import record_overlay

            # Markdown, which the viewer shows beside the signals.
            items = [f"- {text}" for text in differences]
            about = "\n".join(["# A against B", "", *items])
            # Two runs may have one label.
            overlaid = {f"A: {first.label}": first, f"B: {second.label}": second}
            record_overlay(record, overlaid, about)
            out_.note(f"both runs are overlaid in {record.resolve()}")
        rows = []
        for difference in result.differences:
            allowed = difference.tolerance
            # Of a signal without a difference there is no place of the largest.
            row = (
                difference.name,
                difference.unit,
                f"{difference.maximum:.6g}",
                str(difference.at) if difference.maximum > 0 else "",
                "every bit" if allowed is None else f"{allowed:.6g}",
                "" if difference.first is None else str(difference.first),
            )
            rows.append(row)
        header = ("signal", "unit", "largest difference", "at sample", "tolerance", "first beyond")
        out_.table(f"{a} against {b}, {min(result.samples)} samples", header, rows)
        out_.note("\n".join(differences))
        out_.json(result.document())
    # As `diff` does it, so that a script need not read the table.
    if not result.equal:
        raise typer.Exit(1)


def _read_tolerance(option: str) -> tuple[str, float]:
    """Signal and tolerance of an option NAME=VALUE."""
    # The last sign: a signal's name may hold one.
    name, _, value = option.rpartition("=")
    try:
        return name, float(value)
    except ValueError:
        text = f"--tolerance {option}: give NAME=VALUE, e.g. X2=1e-9"
        raise ComparisonError(text) from None
