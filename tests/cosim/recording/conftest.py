import pytest

from cosim import FmuPlant, Scenario


@pytest.fixture(scope="session")
def units(paper):
    with FmuPlant(paper) as plant:
        return plant.units


@pytest.fixture(scope="session")
def foreign(paper):
    """A scenario whose variables' names need escaping, with one state and one action."""
    document = paper.to_dict()
    document["name"] = "tank ∇ 水"
    document["plant"] |= {
        "states": ["tank[1].level"],
        "actions": ["der(x)/dt"],
        "disturbances": [],
        "initial_state": [1.0],
    }
    document["plant"]["mapping"] = {}
    document["disturbance"] = {"law": "none"}
    document["exploration"] = {"kind": "none"}
    document["bounds"] = {
        "state_lower": [0.0],
        "state_upper": [float("inf")],
        "action_lower": [-1.0],
        "action_upper": [1.0],
    }
    document["penalty"] = {"linear": [1.0], "quadratic": [1.0]}
    document["controller"] |= {"reference_state": [0.5], "reference_action": [0.0]}
    return Scenario.from_dict(document)
