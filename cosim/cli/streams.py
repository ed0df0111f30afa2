"""Standard streams that are closed, or that cannot encode what a table holds."""

from __future__ import annotations

import os
import sys


def open_streams() -> None:
    """Make both standard streams writable whatever the caller left of them.

    A character that a stream's encoding lacks is written as its escape. A closed stream swallows
    what it is given; standard output that was closed is refused by `--json`, whose document would
    be lost.
    """
    if sys.stdout is None and "--json" in sys.argv:
        if sys.stderr is not None:
            print("error: standard output is closed: --json prints nowhere", file=sys.stderr)
        sys.exit(2)
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, PTH123
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
