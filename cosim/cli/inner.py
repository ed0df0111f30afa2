"""Runs one command from within another, as if it had been typed."""

from __future__ import annotations

import io
import shlex
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path

from cosim.errors import CosimError


def run_command(words: list[str], out: Path, accepted: tuple[int, ...] = (0,)) -> None:
    """Run `cosim WORDS --out OUT` in this process, silently.

    Raises what the command raises, and CosimError with its last words where it ends otherwise
    than with an `accepted` exit code.
    """
    from cosim.cli.main import app

    said = io.StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said):
            code = app([*words, "--out", str(out)], standalone_mode=False)
    except Exception as error:
        # A usage error's class is private to Typer, which may bring its own copy of click.
        if not hasattr(error, "format_message"):
            raise
        raise CosimError(f"cosim {shlex.join(words)}: {error.format_message()}") from None
    if (code or 0) not in accepted:
        last = said.getvalue().strip().rpartition("\n")[2]
        raise CosimError(f"cosim {shlex.join(words)} ended with code {code}: {last}")
