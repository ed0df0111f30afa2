"""The page on the architecture names files and names that are there."""

import importlib.util
import re

from tests.helpers.code_blocks import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text("utf-8")


def test_every_file_that_the_page_names_is_there():
    named = re.findall(r"`((?:cosim|controllers|learning|fmus|rti_storage|tests)/[\w/.]+)`", PAGE)
    assert len(set(named)) > 30
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_every_module_on_the_one_screen_is_there():
    package, found = "", 0
    for line in PAGE.split("```text")[2].split("```")[0].splitlines()[1:]:
        if not line.startswith(" "):
            package = line.strip("/").replace("/", ".")
            continue
        for name in line.partition(":")[0].split():
            assert importlib.util.find_spec(f"{package}.{name.strip('/')}"), name
            found += 1
    assert found > 60
