"""When the calculated variables change."""

from __future__ import annotations


def test_start_parameters_act_until_initialisation_ends(plant) -> None:
    plant.enter_initialisation()
    assert plant.get("X2") == [25.0]
    plant.set(X2_start=30.0)
    assert plant.get("X2") == [30.0]
