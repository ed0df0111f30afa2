"""The plant: an FMU, shipped or foreign, stepped as a scenario says. Only here is fmpy imported."""

from cosim.plant.fmu_plant import FmuPlant, Snapshot

__all__ = ["FmuPlant", "Snapshot"]
