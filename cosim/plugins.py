"""Loads what users bring along, `module:Name`, and says whose line it was that failed."""

from __future__ import annotations

import importlib
import re
import traceback
from pathlib import Path
from typing import Any

TARGET = re.compile(r"\w[\w.]*:\w[\w.]*")


OURS = ("fmus", "cosim", "controllers", "learning")
"""The packages of this distribution; any other is a user's."""


def load_plugin(target: str, what: str, error: type[Exception]) -> Any:
    """Object that `module:Name` leads to; `what` is what messages call it.

    Raises `error` where the text has another form, where the import fails for whatever reason, or
    where the module has no such name.
    """
    if not TARGET.fullmatch(target):
        raise error(f"{what} must be given as module:Name, not '{target}'")
    module, _, attribute = target.partition(":")
    try:
        found: Any = importlib.import_module(module)
        for part in attribute.split("."):
            found = getattr(found, part)
    # A module may raise anything while it is imported, and one that is a script may even exit.
    except (Exception, SystemExit) as cause:
        raise error(f"{what} cannot be imported: {blamed(cause)}") from cause
    return found


def blamed(cause: BaseException) -> str:
    """What was raised, in a line, and by which line of which file."""
    said = str(cause) if isinstance(cause, ImportError) else f"{type(cause).__name__}: {cause}"
    frames = [
        frame
        for frame in traceback.extract_tb(cause.__traceback__)
        if not frame.filename.startswith("<frozen") and Path(frame.filename) != Path(__file__)
    ]
    where = f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
    return f"{' '.join(said.split())}{where}"
