"""Drive the evaporator sample by sample with fmpy alone, as a controller or learner would.

    python examples/fmpy_loop.py fmus/evaporator.fmu

A proportional controller holds X2 near 26 % with the steam pressure. At sample 30 the state is
saved; later it is restored, and the same samples come again, bit for bit.
"""

import shutil
import sys

from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave

SAMPLING_TIME = 60.0  # s
SAMPLES = 60

path = sys.argv[1]
description = read_model_description(path)
reference = {v.name: v.valueReference for v in description.modelVariables}
folder = extract(path)

plant = FMU2Slave(
    guid=description.guid,
    unzipDirectory=folder,
    modelIdentifier=description.coSimulation.modelIdentifier,
    instanceName="plant",
)
plant.instantiate()
plant.setInteger([reference["seed"]], [7])
plant.setReal([reference["X2_start"], reference["P2_start"]], [25.0, 49.74297])
plant.setupExperiment(startTime=0.0)
plant.enterInitializationMode()
plant.exitInitializationMode()

inputs = [reference["P100"], reference["F200"]]
outputs = [reference["X2"], reference["P2"], reference["economic_cost"]]


def run(first: int, last: int) -> list[list[float]]:
    """Samples first … last−1: measure, act, read the cost of state and action, step."""
    rows = []
    for k in range(first, last):
        (x2,) = plant.getReal(outputs[:1])
        pressure = min(max(195.0 + 8.0 * (26.0 - x2), 100.0), 400.0)
        plant.setReal(inputs, [pressure, 215.88844])
        rows.append(plant.getReal(outputs))
        # time is k times the sampling time, never accumulated
        plant.doStep(k * SAMPLING_TIME, SAMPLING_TIME)
    return rows


rows = run(0, 30)
saved = plant.getFMUstate()
rows += run(30, SAMPLES)
plant.setFMUstate(saved)
repeated = run(30, SAMPLES)
plant.freeFMUstate(saved)

plant.terminate()
plant.freeInstance()
shutil.rmtree(folder)

print(f"mean cost {sum(row[2] for row in rows) / SAMPLES:.3f}, last X2 {rows[-1][0]!r}")
print("restored samples are identical" if repeated == rows[30:] else "restored samples DIFFER")
