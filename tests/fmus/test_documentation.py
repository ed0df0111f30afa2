from __future__ import annotations

import zipfile
from html.parser import HTMLParser

import pytest

import fmus
from fmus.build import BUILD_FILE
from fmus.documentation import documentation_page
from fmus.variables import EVAPORATOR


class Page(HTMLParser):
    """Collects the text, and checks that every element that is opened is closed."""

    VOID = ("meta", "rect", "path")

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.cells: list[str] = []
        self.tags: set[str] = set()
        self.feed(text)
        assert self.open == []

    def handle_starttag(self, tag: str, attributes: object) -> None:
        self.tags.add(tag)
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open and self.open[-1] == "td":
            self.cells.append(data)


@pytest.mark.parametrize("fmi", [2, 3])
def test_page_is_well_formed_with_diagram_equations_and_every_variable(fmi: int) -> None:
    text = documentation_page(fmi, BUILD_FILE)
    page = Page(text)
    assert {"svg", "table", "sub"} <= page.tags
    assert {variable.name for variable in EVAPORATOR.exported(fmi)} <= set(page.cells)
    assert "$" not in text
    for term in ("economic_cost", "Philox4x32-10", "Runge", "C<sub>p</sub>"):
        assert term in text


@pytest.mark.parametrize("name", fmus.NAMES)
def test_page_icon_and_licence_are_in_the_fmu(name: str) -> None:
    with zipfile.ZipFile(fmus.path(name)) as container:
        names = set(container.namelist())
        assert {"documentation/index.html", "documentation/licenses/license.txt"} <= names
        icon = "model.png" if name == "evaporator" else "terminalsAndIcons/icon.png"
        assert container.read(icon).startswith(b"\x89PNG")


def test_licence_in_the_fmu_is_the_project_licence() -> None:
    from pathlib import Path

    project = Path(__file__).parents[2] / "LICENSE"
    with zipfile.ZipFile(fmus.path()) as container:
        assert container.read("documentation/licenses/license.txt") == project.read_bytes()
