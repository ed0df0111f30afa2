"""The scenario of a foreign plant with one state x and one action u."""

SCENARIO = """
schema = 1
name = "{name}"
sampling_time = {sampling_time}
discount = 0.95
[plant]
fmu = "{fmu}"
states = ["x"]
actions = ["u"]
stage_cost = "cost"
initial_state = [1.0]
{plant}
[bounds]
state_lower = [0.0]
state_upper = [inf]
action_lower = [0.0]
action_upper = [3.0]
[penalty]
linear = [10.0]
quadratic = [1.0]
[controller]
reference_state = [1.0]
reference_action = [1.0]
reference_cost = 1.0
"""


def write_one_state(path, fmu, plant, sampling_time=0.5):
    """Write the scenario of an FMU, with more lines for its table [plant]; return its path."""
    path.write_text(
        SCENARIO.format(name=path.stem, sampling_time=sampling_time, fmu=fmu, plant=plant)
    )
    return path
