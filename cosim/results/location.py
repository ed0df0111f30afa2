"""Where the results are that belong to this version."""

from __future__ import annotations

from pathlib import Path

LIST = "experiments.toml"


def stored_results() -> Path:
    """Folder of the stored results: that of an installed wheel, else the checkout's."""
    package = Path(__file__).parent
    return package if (package / LIST).is_file() else package.parents[1] / "results"
