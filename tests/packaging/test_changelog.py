"""Release notes say of every change whether it alters benchmark results."""

import re
from pathlib import Path

CHANGELOG = Path(__file__).parents[2] / "CHANGELOG.md"
MARK = re.compile(r"Results: (unchanged|new|altered: \S.*)\.$", re.DOTALL)


def entries(text):
    """The list items under each version's heading, unwrapped."""
    for section in text.split("\n## ")[1:]:
        for item in re.split(r"\n- ", section)[1:]:
            yield " ".join(item.split("\n\n")[0].split())


def test_every_entry_says_what_it_does_to_results():
    found = list(entries(CHANGELOG.read_text("utf-8")))
    assert len(found) >= 9
    assert [entry for entry in found if not MARK.search(entry)] == []
