"""`cosim benchmark`: speed, each figure beside a reference that was measured in the same run."""

from cosim.cli.benchmark.commands import app

__all__ = ["app"]
