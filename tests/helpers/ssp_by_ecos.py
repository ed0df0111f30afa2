"""Run an SSP by Ecos: python ssp_by_ecos.py loop.ssp STEP SAMPLES prints X2, P2, X1.

Its lines begin with "row", as those of ssp_by_libcosim.
"""

import sys

from ecospy.EcosSimulation import EcosSimulation

SAMPLE = 60.0


def main(path: str, step: float, samples: int) -> None:
    with EcosSimulation(step, ssp_path=path) as simulation:
        simulation.init(parameter_set="plant")
        for _ in range(samples):
            state = [simulation.get_real(f"plant::{name}") for name in ("X2", "P2", "X1")]
            print("row", ",".join(map(repr, state)), flush=True)
            simulation.step(round(SAMPLE / step))


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), int(sys.argv[3]))
