"""The benchmark's other plants as FMUs: an exothermic reactor, four tanks.

Their variables are in `resources/NAME.csv`, their right-hand sides in `equations/NAME.h`.
"""

from __future__ import annotations

import csv
from pathlib import Path

from fmus.build import PACKAGE, RESOURCES
from fmus.model import Model
from fmus.plant import Signal, build_plant, plant_model

PLANTS = {
    "reactor": ("Exothermic stirred-tank reactor with disturbed feed", 12.0),
    # Johansson (2000)
    "tanks": ("Quadruple tank with water drawn at random from the lower tanks", 5.0),
}
"""By its name each plant's description and sampling time [s]."""
_ROLES = ("states", "inputs", "disturbances", "outputs", "parameters")


def model(name: str) -> Model:
    """The table of a plant of `PLANTS`."""
    signals: dict[str, list[Signal]] = {role: [] for role in _ROLES}
    with (RESOURCES / f"{name}.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            start, low, high = (float(row[key]) for key in ("start", "min", "max"))
            signals[row["role"]].append(
                Signal(
                    row["name"], row["unit"], start, low, high, row["description"],
                    float(row["range"] or 0.0),
                )
            )  # fmt: skip
    description, sampling_time = PLANTS[name]
    return plant_model(name, description=description, sampling_time=sampling_time, **signals)


def equations(name: str) -> bytes:
    """The C header with a plant's right-hand side."""
    return (PACKAGE / "equations" / f"{name}.h").read_bytes()


def build(folder: Path, every_platform: bool = False) -> list[Path]:
    """Build both FMUs (FMI 2.0) into `folder` and return their paths."""
    return [
        build_plant(model(name), equations(name), folder / f"{name}.fmu", 2, every_platform)
        for name in PLANTS
    ]
