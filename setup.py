"""Puts the stored results into the wheel, inside the package that checks them."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

# Recordings are large and are made anew by one command; `.work` is what unfinished runs left.
LEFT_OUT = shutil.ignore_patterns(".work", "*.rrd", "report.html")


class BuildWithResults(build_py):
    """Copies results/ to cosim/results/."""

    def run(self) -> None:
        """Build the packages, then add the results; an editable install reads them in place."""
        super().run()
        if not self.editable_mode:
            target = Path(self.build_lib) / "cosim" / "results"
            shutil.copytree("results", target, ignore=LEFT_OUT, dirs_exist_ok=True)


setup(cmdclass={"build_py": BuildWithResults})
