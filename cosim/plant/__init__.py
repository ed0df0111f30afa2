"""The plant: an FMU, shipped or foreign, stepped as a scenario says. Only here is fmpy imported."""

from cosim.plant.fmu_plant import FmuPlant
from cosim.plant.isolated import IsolatedPlant
from cosim.plant.snapshot import Snapshot

__all__ = ["FmuPlant", "IsolatedPlant", "Snapshot"]
