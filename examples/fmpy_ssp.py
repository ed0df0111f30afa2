"""Run the closed loop of an SSP with fmpy alone: python examples/fmpy_ssp.py loop.ssp 100

At each sample the controller acts on the plant's present state, then the plant takes the step: the
order of the components in the file. `cosim export tuned --out c.fmu --ssp loop.ssp` writes one.
"""

import shutil
import sys

from fmpy import extract, read_model_description
from fmpy.ssp.simulation import free_fmu, get_value, instantiate_fmu, set_value
from fmpy.ssp.ssd import find_components, get_connections, read_ssd, read_ssv

archive, samples = sys.argv[1], int(sys.argv[2])
folder, system = extract(archive), read_ssd(archive).system
components = find_components(system)
starts = read_ssv(archive, "resources/plant.ssv")
for parameter in starts.parameters:
    parameter.name = f"plant.{parameter.name}"
    if parameter.type == "Boolean":  # fmpy takes the word false for true
        parameter.value = float(parameter.value == "true")
for component in components:
    instantiate_fmu(component, folder, start_time=0.0, parameter_set=starts)
step = float(read_model_description(f"{folder}/{components[0].source}").defaultExperiment.stepSize)

controller = components[0]
names = [connector.name for connector in controller.connectors]  # the states, then the actions
print(",".join(["time", *names]))
for k in range(samples):
    for component in components:
        for start, end in get_connections(system):
            if end.parent is component:
                set_value(component, end.name, get_value(start.parent, start.name))
        component.fmu.doStep(currentCommunicationPoint=k * step, communicationStepSize=step)
    print(",".join(repr(x) for x in (k * step, *(get_value(controller, n) for n in names))))
for component in components:
    free_fmu(component)
shutil.rmtree(folder)
