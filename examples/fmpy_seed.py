"""The plant under the noise of a benchmark's seed, with fmpy alone.

cosim scenario paper --seed-values 3 --json > start.json
python examples/fmpy_seed.py fmus/evaporator.fmu start.json
"""

import json
import sys
from pathlib import Path

from fmpy import simulate_fmu

starts = json.loads(Path(sys.argv[2]).read_text())["start_values"]
result = simulate_fmu(
    sys.argv[1],
    start_values=starts,
    stop_time=20 * 60.0,
    output_interval=60.0,
    output=["X2", "P2", "X1", "F1"],
)
for row in result:
    print(*(repr(float(value)) for value in row), sep=",")
