"""Names of the files that the commands write to `--out`: all in a folder belong to one run."""

from __future__ import annotations

from cosim.core.training_options import CHECKPOINT, LOG, PARAMETERS

COMMON_FILES = ("summary.json", "scenario.toml")
"""Files that every command writes; who finds them reads the others by them."""
SIMULATION_FILES = (
    "trajectory.csv",
    "trajectory.parquet",
    "trajectory.png",
    "timing.csv",
    "timing.parquet",
    "run.rrd",
    *COMMON_FILES,
)
EVALUATION_FILES = (
    "evaluation.csv",
    "timing.csv",
    "evaluation.png",
    "judged.csv",
    *COMMON_FILES,
)
DEMO_FILES = (*EVALUATION_FILES, "before-after.png", "demo.rrd")
SHADOW_FILES = ("shadow.csv", "shadow.png", "shadow.rrd", *COMMON_FILES)
TRAINING_FILES = (
    CHECKPOINT,
    LOG,
    PARAMETERS,
    "learning.png",
    "learning.gif",
    "training.rrd",
    *COMMON_FILES,
)
ANSWER_FILES = (PARAMETERS, "known.png", *COMMON_FILES)
"""Files of a training from logged data."""
RUN_FILES = tuple(
    dict.fromkeys(
        (
            *SIMULATION_FILES,
            *DEMO_FILES,
            *SHADOW_FILES,
            *TRAINING_FILES,
            *ANSWER_FILES,
        )
    )
)
"""Files of any run: the summary of one beside the table of another would tell of the wrong one."""
STUDY_MARKS = ("study.json", "runs/*/run.json", "runs/*/*/run.json", "runs/*/*/*/run.json")
"""Patterns of files that only a study writes."""
