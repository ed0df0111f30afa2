"""Every code block of README.md and docs/ is executed, page by page, in an empty folder."""

import sys

import pytest

from tests.helpers.code_blocks import COVERED, FENCE, ROOT, SMALLER, Session, blocks, is_slow, pages


def parameters():
    for page in pages():
        if blocks(page):
            name = str(page.relative_to(ROOT))
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


def test_every_smaller_budget_stands_in_for_one_on_a_page():
    text = "".join(page.read_text() for page in pages())
    assert all(budget in text for budget in SMALLER)


def test_no_fence_escapes_the_collector():
    for page in pages():
        fences = [line for line in page.read_text().splitlines() if line.startswith("```")]
        assert len(fences) == 2 * len(FENCE.findall(page.read_text())), page


def test_what_is_not_typed_is_on_a_page_and_covered_elsewhere():
    text = "".join(page.read_text() for page in pages())
    makefile = (ROOT / "Makefile").read_text()
    script = (ROOT / ".ci" / "run").read_text()
    for command in COVERED:
        assert f"$ {command}" in text, f"{command} is on no page"
        if command.startswith("make "):
            assert f"\n{command.removeprefix('make ')}:" in makefile
    assert "make test" in script
    assert "make check" in script
    assert "cosim demo" in makefile[makefile.index("\ncheck:") :]
