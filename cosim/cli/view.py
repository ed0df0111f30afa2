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
        float | None,
        typer.Option(
            "--at",
            help="Cursor of the PNG: time in s (training: sample); default: the worst violation of "
            "a run, or the end.",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Open a recording in the Rerun viewer, draw it to a PNG, or (--json) print what it holds."""
    with output(json) as out:
        from cosim.errors import CosimError
        from cosim.recording import open_viewer, render, summarise

        if at is not None and png is None:
            raise CosimError("--at places the cursor of a PNG: it needs --png FILE")
        if png is not None:
            render(file, png, at=at)
            out.note(f"drawn to {png}")
        elif not json:
            open_viewer(file)
        if json:
            out.json(summarise(file))
