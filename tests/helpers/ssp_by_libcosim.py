"""Run an SSP by libcosim: python ssp_by_libcosim.py loop.ssp STEP SAMPLES prints X2, P2, X1.

Its lines begin with "row", since libcosim logs to the same place.
"""

import sys
import tempfile
import zipfile

import fmpy
from libcosimpy.CosimExecution import CosimExecution
from libcosimpy.CosimObserver import CosimObserver

SAMPLE = 60.0


def main(path: str, step: float, samples: int) -> None:
    folder = tempfile.mkdtemp()
    with zipfile.ZipFile(path) as container:
        container.extractall(folder)
    execution = CosimExecution.from_ssp_file(
        f"{folder}/SystemStructure.ssd", step_size=round(step * 1e9)
    )
    observer = CosimObserver.create_last_value()
    execution.add_observer(observer)
    plant = next(s.index for s in execution.slave_infos() if s.name == b"plant")
    description = fmpy.read_model_description(f"{folder}/resources/plant.fmu")
    reference = {v.name: v.valueReference for v in description.modelVariables}
    for _ in range(samples):
        state = observer.last_real_values(plant, [reference[name] for name in ("X2", "P2", "X1")])
        print("row", ",".join(map(repr, state)))
        for _ in range(round(SAMPLE / step)):
            execution.step()


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), int(sys.argv[3]))
