"""What pyproject.toml cannot say: the results in the wheel, the description for an index."""

import re
import shutil
import tomllib
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

# Recordings and figures are made anew by one command; `.work` is what unfinished runs left.
LEFT_OUT = shutil.ignore_patterns(".work", "figures", "*.rrd", "report.html")


class BuildWithResults(build_py):
    """Copies results/ to cosim/results/."""

    def run(self) -> None:
        """Build the packages, then add the results; an editable install reads them in place."""
        super().run()
        if not self.editable_mode:
            target = Path(self.build_lib) / "cosim" / "results"
            shutil.copytree("results", target, ignore=LEFT_OUT, dirs_exist_ok=True)


def description() -> str:
    """README, with absolute links, or without those that an index cannot follow."""
    text = Path("README.md").read_text("utf-8")
    project = tomllib.loads(Path("pyproject.toml").read_text("utf-8"))["project"]
    if base := project.get("urls", {}).get("Repository"):
        text = re.sub(r"(!\[[^]]*\]\()(?!https?:|#)", rf"\1{base}/raw/HEAD/", text)
        return re.sub(r"(?<!!)(\[[^]]*\]\()(?!https?:|#)", rf"\1{base}/blob/HEAD/", text)
    text = re.sub(r"!\[[^]]*\]\((?!https?:).*?\)\n\n\*.*?\*\n\n", "", text, flags=re.DOTALL)
    return re.sub(r"\[([^]]*)\]\((?!https?:|#).*?\)", r"\1", text)


setup(
    cmdclass={"build_py": BuildWithResults},
    long_description=description(),
    long_description_content_type="text/markdown",
)
