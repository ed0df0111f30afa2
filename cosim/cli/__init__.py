"""The `cosim` command line: it composes plants, controllers, learning and records."""

from cosim.cli.main import app, main

__all__ = ["app", "main"]
