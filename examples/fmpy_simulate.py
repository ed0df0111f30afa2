"""Simulate the evaporator with fmpy alone: one call, inputs from a CSV file, several seeds.

    python examples/fmpy_simulate.py fmus/evaporator.fmu examples/fmpy_inputs.csv

It works the same with evaporator_fmi3.fmu. Prints the mean economic cost and the share of samples
below the quality bound X2 ≥ 25 % for the nominal plant and for three seeds. The file's columns
X1_in, F1_in, T1_in and T200_in would act with `override` set to true: recorded disturbances.
"""

import sys

import numpy as np
from fmpy import read_csv, simulate_fmu

fmu, inputs = sys.argv[1:]
disturbances = ["X1", "F1", "T1", "T200"]

for label, values in {
    "nominal": {"stochastic": False},
    "seed 1": {"seed": 1},
    "seed 2": {"seed": 2},
    "seed 3, normal law": {"seed": 3, "law": "2", "X1_range": 1.0, "F1_range": 2**0.5},
}.items():
    result = simulate_fmu(
        fmu,
        stop_time=3600.0,  # s
        output_interval=60.0,  # always give it: beyond 1000 points fmpy would choose a coarser one
        fmi_type="CoSimulation",
        start_values=values,
        input=read_csv(inputs),
        output=["X2", "P2", "economic_cost", *disturbances],
    )
    cost = np.mean(result["economic_cost"])
    below = np.mean(result["X2"] < 25.0)
    print(f"{label}: mean cost {cost:.3f}, X2 below 25 % in {below:.1%} of samples")
