"""`cosim view`: look at a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.output import JsonOption, output


def view(
    file: Annotated[Path, typer.Argument(help="Recording (.rrd).", show_default=False)],
    png: Annotated[
        Path | None, typer.Option("--png", help="Draw it to a PNG instead; needs no screen.")
    ] = None,
    at: Annotated[
        float | None, typer.Option("--at", help="Time of the cursor in the PNG, in s.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Open a recording in the Rerun viewer, draw it to a PNG, or (--json) print what it holds."""
    with output(json) as out:
        from cosim.recording import open_viewer, render, summarise

        if png is not None:
            render(file, png, at=at)
            out.note(f"drawn to {png}")
        elif not json:
            open_viewer(file)
        if json:
            out.json(summarise(file))
