"""The board: every entry holds and its page is the one of today; what is wrong is refused."""

import shutil
from pathlib import Path

import pytest

from cosim.errors import CosimError
from cosim.studies.board import read_entry, write_board

BOARD = Path(__file__).parents[3] / "results" / "board"


@pytest.mark.slow
def test_every_entry_holds_and_the_page_shows_it(tmp_path):
    shutil.copytree(BOARD, tmp_path, dirs_exist_ok=True)
    (tmp_path / "README.md").unlink()
    names = write_board(tmp_path)
    assert names == sorted(path.name for path in BOARD.iterdir() if path.is_dir())
    assert (tmp_path / "README.md").read_text() == (BOARD / "README.md").read_text(), (
        "write the page with: cosim results board"
    )


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("entry.toml", ("authors", "writers"), "authors"),
        ("entry.toml", ("PI loops", "a | b"), "name"),
        ("entry.toml", ('"paper"', '"../paper"'), "scenario"),
        ("entry.toml", ("samples = 0", "samples = 7"), "samples must be 0"),
        ("entry.toml", ("samples = 0", "samples = 0\nsteps = 100"), "3000000, 100, "),
        ("entry.toml", ("PI loops", "PI " * 40), "name"),
        ("entry.toml", ("authors", "#" * 3_000_000 + "\nauthors"), "bytes"),
        ("judged.csv", ("3000001,2000", "3000009,2000"), "must have J"),
        ("judged.csv", (",J,", ",K,"), "'J'"),
        ("judged.csv", (",paper,", ",paper,0"), "scenario_hash"),
        ("judged.csv", ("50614.", "40614."), "give judged.csv's row"),
        ("runs/run-3000000.csv", ("26.", "27."), "noise"),
    ],
)
def test_a_wrong_entry_is_refused(tmp_path, file, change, words):
    shutil.copytree(BOARD / "pi-paper", tmp_path / "mine")
    path = tmp_path / "mine" / file
    text = path.read_text().replace(*change)
    assert text != path.read_text()
    path.write_text(text)
    with pytest.raises(CosimError, match=words):
        read_entry(tmp_path / "mine")
