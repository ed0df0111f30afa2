"""Run the closed loop of an SSP with fmpy alone: python examples/fmpy_ssp.py loop.ssp 100

At each sample the controller acts on the plant's present state, then the plant takes the step: the
order of the components in the file. `cosim export tuned --out c.fmu --ssp loop.ssp` writes one.
"""

import shutil
import sys
from pathlib import Path
from xml.etree import ElementTree

from fmpy import extract, instantiate_fmu, read_model_description
from fmpy.simulation import apply_start_values

archive, samples = sys.argv[1], int(sys.argv[2])
folder = Path(extract(archive))
system = ElementTree.parse(folder / "SystemStructure.ssd").getroot()
values = ElementTree.parse(folder / "resources/plant.ssv").getroot()
starts = {each.get("name"): each[0].get("value") for each in values.findall(".//{*}Parameter")}
fmus, variables = {}, {}
for component in system.findall(".//{*}Component"):
    name, unpacked = component.get("name"), extract(folder / component.get("source"))
    description = read_model_description(unpacked)
    fmu = fmus[name] = instantiate_fmu(unpacked, description, "CoSimulation")
    variables[name] = {variable.name: variable for variable in description.modelVariables}
    if name == "plant":
        for key, text in starts.items():  # SSP 2.0 names the item of an enumeration
            declared = variables[name][key].declaredType
            items = {} if declared is None else {each.name: each.value for each in declared.items}
            starts[key] = items.get(text, text)
        apply_start_values(fmu, description, starts)
    if description.fmiVersion == "2.0":
        fmu.setupExperiment(startTime=0.0)
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    step = float(description.defaultExperiment.stepSize)


def exchange(verb, element, name, *values):
    variable = variables[element][name]
    call = getattr(fmus[element], f"{verb}{variable.type}")
    return call([variable.valueReference], *values)


controller = system.find(".//{*}Component[@name='controller']")
names = [connector.get("name") for connector in controller.findall(".//{*}Connector")]
print(",".join(["time", *names]))  # the states, then the actions
for k in range(samples):
    for name, fmu in fmus.items():
        for each in system.findall(".//{*}Connection"):
            if each.get("endElement") == name:
                value = exchange("get", each.get("startElement"), each.get("startConnector"))
                exchange("set", name, each.get("endConnector"), value)
        fmu.doStep(currentCommunicationPoint=k * step, communicationStepSize=step)
    numbers = (exchange("get", "controller", name)[0] for name in names)
    print(",".join(repr(number) for number in (k * step, *numbers)))
for fmu in fmus.values():
    fmu.terminate()
    fmu.freeInstance()
shutil.rmtree(folder)
