"""`cosim view`: look at a recording."""

from __future__ import annotations

from pathlib import Path

from cosim.cli.output import JsonOption, output


def view(
    file: Path,
    png: Path | None = None,
    at: float | None = None,
    json: JsonOption = False,
) -> None:
    """Open a recording in the Rerun viewer, draw it as a PNG, or list its content (--json).

    Args:
        file: Recording (.rrd).
        png: Draw it as a PNG instead, without a screen.
        at: Cursor of the PNG: time in s (training: sample); default: the worst violation of a run,
            or the end.
    """
    with output(json) as out:
        from cosim.core.errors import CosimError
        from cosim.recording import open_viewer, render, summarise

        if at is not None and png is None:
            raise CosimError("--at places the cursor of a PNG: it needs --png FILE")
        if png is not None:
            render(file, png, at=at)
            out.note(f"drawn to {png}")
        # A script that asks for JSON waits for no window.
        elif not json:
            open_viewer(file)
        if json:
            out.json(summarise(file))
