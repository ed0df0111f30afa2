"""`cosim export`: the learned controller as an FMU or as C, and the closed loop as an SSP."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

import cosim
from cosim.cli.output import JsonOption, ScenarioOption, output, split_names


def export(
    controller: str,
    out: Annotated[Path, typer.Option("--out", "-o")],
    scenario: ScenarioOption = "paper",
    format_: Annotated[Literal["fmu", "c"], typer.Option("--format")] = "fmu",
    single: Annotated[bool, typer.Option("--single")] = False,
    measured: str = "",
    fmi: Annotated[int, typer.Option(min=2, max=3)] = 2,
    local: Annotated[bool, typer.Option("--local")] = False,
    ssp: Path | None = None,
    seed: int = 0,
    json: JsonOption = False,
) -> None:
    """Write an RTI-NMPC as a self-contained co-simulation FMU, or C, that needs no Python.

    Builds for Linux, Windows and macOS, x86_64 and ARM64, with pip install 'rti-cosim\\[cross]'.
    Without that package, or with --local, it builds for this machine by its C compiler. The entries
    of θ are tunable parameters.

    Args:
        controller: naive, tuned, backed-off, cautious or a parameters file (.toml) of a training.
        out: The FMU's file; with --format c a folder.
        format_: fmu, or c: one .c and .h, no FMI.
        single: With --format c: float in place of double.
        measured: Disturbances that are inputs, such as X1,T1.
        fmi: FMI version: 2 or 3.
        local: Build for this machine alone, by $CC or cc.
        ssp: Write the loop with the plant here.
        seed: Seed of the plant in the SSP, as in cosim simulate.
    """
    with output(json) as out_:
        from importlib.util import find_spec

        from cosim.cli import controller_fmu
        from cosim.core.errors import CosimError
        from cosim.core.files import check_target
        from fmus import PLATFORMS, present
        from fmus.model import FmiVersion

        for target in [out] if ssp is None else [out, ssp]:
            if not target.parent.is_dir():
                raise CosimError(f"{target}: there is no folder {target.parent} to write it to")
            # Before the minutes that compilers may take.
            if format_ == "fmu":
                check_target(target)
        loaded = cosim.Scenario.load(scenario)
        # Each once: a name twice would be two inputs.
        words = split_names(measured)
        names = tuple(dict.fromkeys(words))
        missing = set(names) - set(loaded.plant.disturbances)
        # In the SSP the plant is what measures them; elsewhere the user connects them.
        if ssp is not None and missing:
            raise CosimError(f"--ssp: the plant has no disturbance {', '.join(sorted(missing))}")
        if ssp is not None and loaded.sensors:
            raise CosimError(
                f"--ssp: scenario '{loaded.name}' has sensors, whose noise and delays no FMU has: "
                "leave --ssp out"
            )
        if ssp is not None and loaded.signals:
            raise CosimError(
                f"--ssp: scenario '{loaded.name}' has signals, which no FMU of the loop gives: "
                "leave --ssp out"
            )
        rti = controller_fmu.rti_controller(controller, loaded, names)
        if format_ == "c":
            if ssp is not None:
                raise CosimError("--ssp connects FMUs: leave --format c out")
            summary = controller_fmu.write_c(rti, loaded, out, single)
            out_.note(f"wrote {', '.join(summary['files'])} to {out}")
            out_.json(summary)
            return
        if single:
            raise CosimError("--single goes with --format c: an FMU's numbers are doubles")
        # The cross-compiler is an extra of this package.
        every_platform = not local and find_spec("ziglang") is not None
        version: FmiVersion = 3 if fmi == 3 else 2
        path = controller_fmu.write_fmu(
            rti,
            loaded,
            out,
            version,
            measured=names,
            every_platform=every_platform,
        )
        built_for = PLATFORMS if every_platform else [present()]
        platforms = [platform.tuple for platform in built_for]
        out_.note(f"wrote {path}: FMI {version}.0 for {', '.join(platforms)}")
        document = {
            "fmu": str(path),
            "fmi_version": f"{version}.0",
            "platforms": platforms,
            "scenario": loaded.name,
            "scenario_hash": loaded.hash,
            "theta_hash": rti.parameters.hash,
            "sampling_time": loaded.sampling_time,
        }
        if ssp is not None:
            written = controller_fmu.write_loop(path, loaded, seed, ssp, names)
            document["ssp"] = str(written)
            out_.note(f"wrote {ssp}")
        out_.json(document)
