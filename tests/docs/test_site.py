"""The site is built strictly, and documents every public module that it lists."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def build(tmp_path_factory):
    """Folder of the built site and what the builder said."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    quiet = os.environ | {"NO_MKDOCS_2_WARNING": "1"}  # the theme's own advertisement
    result = subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False, env=quiet
    )
    assert result.returncode == 0, result.stderr
    return folder, result.stderr


@pytest.mark.slow
def test_the_site_builds_without_a_warning(build):
    folder, said = build
    assert "WARNING" not in said
    page = (folder / "reference" / "controllers" / "index.html").read_text()
    assert "controllers.rti.nmpc.RtiNmpc.feedback" in page


@pytest.mark.slow
def test_the_reference_shows_nothing_private(build):
    for package in ("controllers", "cosim", "fmus", "learning"):
        page = build[0] / "reference" / package / "index.html"
        anchors = re.findall(r'<h\d id="([^"]+)"', page.read_text())
        assert len(anchors) > 10
        assert [name for name in anchors if re.search(r"(^|\.)_", name)] == []


@pytest.mark.slow
def test_every_formula_is_mathml_that_browsers_know(build):
    folder, _ = build
    page = (folder / "method" / "index.html").read_text()
    formulas = re.findall(r"<math.*?</math>", page, re.DOTALL)
    source = (ROOT / "docs" / "method.md").read_text()
    assert len(formulas) == len(re.findall(r"\$\$.*?\$\$|\$[^$]+\$", source, re.DOTALL))
    assert "arithmatex" not in re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    for formula in formulas:
        text = re.sub(r"<[^>]+>", "", formula)
        # Neither commands nor cell marks that the converter did not know, nor letters of another
        # alphabet by attribute, which MathML Core drops.
        assert "\\" not in text, formula
        assert not re.search(r"&(?!#?\w+;)", text), formula
        assert not re.search(r'mathvariant="(?!normal)', formula), formula


@pytest.mark.slow
def test_nothing_is_loaded_from_elsewhere(build):
    folder, _ = build
    for page in folder.rglob("*.html"):
        loads = re.findall(r'<(?:script|img|iframe|source)[^>]* src="([^"]+)"', page.read_text())
        loads += re.findall(
            r'<link[^>]*rel="(?:stylesheet|icon)"[^>]*href="([^"]+)"', page.read_text()
        )
        assert loads
        for address in loads:
            assert "//" not in address, f"{page}: {address}"
            assert (page.parent / address.split("?")[0]).exists() or page.name == "404.html"


def test_every_page_is_in_the_navigation():
    listed = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    assert listed == {str(p.relative_to(ROOT / "docs")) for p in (ROOT / "docs").rglob("*.md")}
