"""Run an SSP's closed loop by fmpy's own master: python examples/fmpy_simulate_ssp.py loop.ssp 9

It steps plant and controller side by side, each on what the other had one step before, and knows
nothing but zeros for the first step. So the steps are small, and the first one ends at time zero.
"""

import sys

from fmpy.ssp.simulation import simulate_ssp
from fmpy.ssp.ssd import read_ssv

archive, samples = sys.argv[1], int(sys.argv[2])
sampling_time, parts = 60.0, int(sys.argv[3]) if len(sys.argv) > 3 else 64
step = sampling_time / parts  # a power of two: fmpy adds steps up, here without rounding
starts = read_ssv(archive, "resources/plant.ssv")
for parameter in starts.parameters:
    parameter.name = f"plant.{parameter.name}"
rows = simulate_ssp(archive, -step, samples * sampling_time, step_size=step, parameter_set=starts)[
    ::parts
]  # a row has the outputs at the end of its step
names = ("plant.X2", "plant.P2", "controller.P100", "controller.F200")
print("time,X2,P2,P100,F200")
for row in rows:
    print(",".join(repr(float(row[name])) for name in ("time", *names)))
