"""What the runs of a study depend on."""

import shutil
from pathlib import Path

from cosim.study.definition import Definition
from cosim.study.plan import plan

ROOT = Path(__file__).parents[3]
DOCUMENT = {
    "schema": 1,
    "name": "moved",
    "scenarios": ["paper"],
    "training_seeds": {"first": 0, "count": 1},
    "evaluation": {"first_seed": 100000, "seeds": 1, "steps": 10},
    "case": [
        {"controller": "clean.toml"},
        {"name": "q", "algorithm": "q-learning", "samples": 1000, "start": "clean.toml"},
    ],
}


def facts(folder):
    """Facts of the runs of the study in a folder that holds its start."""
    folder.mkdir()
    shutil.copy(ROOT / "results" / "starts" / "clean.toml", folder)
    return {run.key: run.facts for run in plan(Definition.from_dict(DOCUMENT, folder)).runs}


def test_a_study_that_moved_to_another_folder_keeps_its_runs(tmp_path):
    assert facts(tmp_path / "here") == facts(tmp_path / "there")


def test_another_theta_at_the_start_is_another_run(tmp_path):
    here = facts(tmp_path / "here")
    start = tmp_path / "there" / "clean.toml"
    definition = Definition.from_dict(DOCUMENT, start.parent)
    start.parent.mkdir()
    shutil.copy(ROOT / "results" / "starts" / "fouled.toml", start)
    changed = {run.key: run.facts for run in plan(definition).runs}
    assert [key.case for key in here if here[key] != changed[key]] == ["clean", "q"]
