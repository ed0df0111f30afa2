"""What the package says of itself."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_the_authors_are_those_of_the_licence():
    (author,) = PROJECT["authors"]
    assert author["name"] in (ROOT / "LICENSE").read_text()
    assert author["name"] in (ROOT / "CITATION.cff").read_text()


def test_the_citation_is_of_this_version():
    assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text()


def test_every_dependency_is_explained():
    page = (ROOT / "docs" / "packaging.md").read_text()
    for requirement in PROJECT["dependencies"]:
        assert f"`{requirement.partition('>')[0]}`" in page, requirement


def test_every_supported_python_is_a_classifier():
    assert PROJECT["requires-python"] == ">=3.11"
    versions = [c.rpartition(" ")[2] for c in PROJECT["classifiers"] if ":: 3." in c]
    assert versions == ["3.11", "3.12", "3.13"]
