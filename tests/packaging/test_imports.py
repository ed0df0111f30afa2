"""Every module of the packages is imported once, with warnings as errors."""

import subprocess
import sys

CODE = """
import importlib, pkgutil
for package in ("fmus", "cosim", "controllers", "learning"):
    root = importlib.import_module(package)
    for found in pkgutil.walk_packages(root.__path__, package + "."):
        if not found.name.endswith("__main__"):
            importlib.import_module(found.name)
            print(found.name)
"""


def test_no_module_warns_when_it_is_imported():
    result = subprocess.run(
        [sys.executable, "-W", "error", "-c", CODE],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert not result.stderr
    assert "learning.training" in result.stdout
