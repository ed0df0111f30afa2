"""Train a controller on a fouled evaporator, and look at what it learnt. Open it as a notebook."""

# %% Train: the plant's condenser is fouled, and the controller's model does not know
from pathlib import Path

from learning import train

SAMPLES = 20_000
out = Path("notebook-train")
rule = {"rule": "q-learning"}
training = train("search", "fouled", SAMPLES, seed=0, settings=rule, evaluate_every=1000)
print(f"{training.status}: J = {training.J:.1f}, regret {100 * training.regret:.2f} %")

# %% The learning curve: cost of training and of the greedy policy, violations, TD error, θ
training.save(out)
training.figure()

# %% What θ does: the lower bounds that the controller keeps, against those that it is told
learnt, told = training.parameters["x_l"], training.run.scenario.state_lower
for name, keeps, bound in zip(training.run.scenario.plant.states, learnt, told, strict=True):
    print(f"{name}: keeps {keeps:.2f}, the bound is {bound:.2f}")

# %% The learnt controller in the loop
from cosim import FmuPlant, simulate  # noqa: E402
from cosim.figures import overlay_figure  # noqa: E402
from cosim.plugins import build_controller  # noqa: E402

scenario = training.run.scenario
with FmuPlant(scenario) as plant:
    before = simulate(plant, build_controller("naive", scenario), steps=200, seed=1)
    after = simulate(plant, training.controller(), steps=200, seed=1)
overlay_figure({"naive": before, "learned": after})
