"""The plant: an FMU, shipped or foreign, stepped as a scenario says. Only here is fmpy imported."""

from cosim.plant.fmu_plant import FmuPlant, Snapshot
from cosim.plant.isolated import IsolatedPlant

__all__ = ["FmuPlant", "IsolatedPlant", "Snapshot"]
