"""The `cosim` command line: it composes plants, controllers, learning and records."""

import gc

gc.set_threshold(200_000)  # what a command imports at its start is no garbage

from cosim.cli.main import app, main  # noqa: E402

__all__ = ["app", "main"]
