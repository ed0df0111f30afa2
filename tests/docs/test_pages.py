"""README and docs/: every block runs, every link and every file that a page names is there."""

import importlib
import importlib.util
import re
import sys

import pytest

from tests.helpers.code_blocks import ROOT, Session, blocks, is_slow, pages

PAGES = {str(page.relative_to(ROOT)): page for page in pages()}
FOLDERS = "cosim|controllers|learning|fmus|tests|results|examples|benchmarks|docs"


def parameters():
    for name, page in PAGES.items():
        if blocks(page):
            yield pytest.param(page, id=name, marks=pytest.mark.slow if is_slow(page) else ())


@pytest.mark.parametrize("page", list(parameters()))
def test_the_page_does_what_it_says(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    session = Session(page, tmp_path)
    before = set(sys.modules)
    try:
        for block in blocks(page):
            session.follow(block)
    finally:
        # Modules that a page wrote are not those of the next page.
        for name in set(sys.modules) - before:
            if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
                del sys.modules[name]


def anchors(page):
    """Anchors of a page's headings."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", h).strip().lower().replace(" ", "-") for h in headings}


@pytest.mark.parametrize("name", PAGES)
def test_every_link_resolves(name):
    page, missing = PAGES[name], []
    for link in re.findall(r"\]\((?!https?:)([^)\s]+)\)", page.read_text()):
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        made = target.parent.name == "reference" or target.suffix != ".md"
        known = {anchor} if made or not anchor else anchors(target)
        # What is not committed, a clone does not have.
        if "figures" in target.parts or not target.exists() or anchor not in known:
            missing.append(link)
    assert missing == []


@pytest.mark.slow
def test_the_pictures_of_the_results_page_are_those_of_the_stored_tables(tmp_path, monkeypatch):
    """Where a table has changed, `make pictures` draws them anew."""
    file = ROOT / "docs" / "pictures.py"
    spec = importlib.util.spec_from_file_location("pictures", file)
    pictures = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(pictures)
    monkeypatch.setattr(pictures, "IMAGES", tmp_path)
    pictures.draw_results()
    page = (ROOT / "docs" / "results.md").read_text()
    shown = set(re.findall(r"\]\(images/(.+?\.svg)\)", page))
    assert shown == {path.name for path in tmp_path.iterdir()}
    images = ROOT / "docs" / "images"
    assert [
        name
        for name in sorted(shown)
        if (images / name).read_bytes() != (tmp_path / name).read_bytes()
    ] == []


@pytest.mark.parametrize("name", PAGES)
def test_every_file_that_the_page_names_is_there(name):
    named = re.findall(rf"(?<![\w/.])((?:{FOLDERS})/[\w./-]+\.\w+)", PAGES[name].read_text())
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_every_module_of_the_reference_is_there():
    text = "".join(page.read_text() for page in (ROOT / "docs" / "reference").glob("*.md"))
    for name in re.findall(r"^::: (\S+)$", text, re.MULTILINE):
        importlib.import_module(name)
    for package in ("fmus", "cosim", "controllers", "learning"):
        module = importlib.import_module(package)
        assert [name for name in module.__all__ if not hasattr(module, name)] == []


def test_every_page_of_the_site_is_in_the_navigation():
    listed = set(re.findall(r": (\S+\.md)$", (ROOT / "mkdocs.yml").read_text(), re.MULTILINE))
    of_the_site = {name.removeprefix("docs/") for name in PAGES if name.startswith("docs/")}
    assert listed == of_the_site
