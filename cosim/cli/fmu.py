"""`cosim fmu`: the contents of an FMU, its check, and the build of the shipped ones."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from cosim.cli.output import JsonOption, output, writable_folder

SHOWN = 1000
"""Variables of a table at most: a table of 200 000 takes minutes to print."""

app = typer.Typer(help="Look into an FMU, check it, build ours.")

FileArgument = Annotated[
    str, typer.Argument(help="FMU file, or evaporator, evaporator_fmi3, reactor, tanks (shipped).")
]


def _path(name: str) -> Path:
    import fmus

    return fmus.path(name) if name in (*fmus.NAMES, *fmus.PLANTS) else Path(name)


@app.command()
def info(file: FileArgument = "evaporator", json: JsonOption = False) -> None:
    """Show an FMU's interfaces, platforms, flags, variables, and what bars it as a plant."""
    with output(json) as out_:
        from cosim.errors import PlantError
        from cosim.plant.fmi import unpack
        from cosim.plant.wiring import refusals
        from fmus.check import information

        try:
            unpacked = unpack(_path(file))
            description, refused = unpacked.description, list(refusals(unpacked))
        except PlantError as error:
            description, refused = None, [str(error)]
        found = information(_path(file), description)
        binaries = ", ".join(
            f"{folder} ({', '.join(made_for)})" if made_for else folder
            for folder, made_for in found["platforms"].items()
        )
        out_.note(
            f"{found['path']}\nsha256 {found['sha256']}\n{found['name']}: {found['description']}\n"
            f"FMI {found['fmi_version']}: {', '.join(found['flags'])}\nbinaries: {binaries}"
        )
        out_.note("\n".join(f"no plant: {reason}" for reason in refused) or "the plant accepts it")
        faces = found["flags"].values()
        names = dict.fromkeys(name for face in faces for name in face)
        flags = [(name, *(face.get(name, "–") for face in faces)) for name in names]
        out_.table("capability flags", ("flag", *found["flags"]), flags)
        header = ("name", "causality", "unit", "start", "min", "max")
        rows = [[str(v[key] or "") for key in header] for v in found["variables"][:SHOWN]]
        count = len(found["variables"])
        more = f", the first {SHOWN} here, all with --json" if count > SHOWN else ""
        out_.table(f"{count} variables{more}", header, rows)
        out_.json(found | {"refusals": refused})


@app.command()
def check(file: FileArgument = "evaporator", json: JsonOption = False) -> None:
    """Validate an FMU's model description, read all its variables, run its experiment.

    Exit code 1 if the FMU is wrong.
    """
    with output(json) as out_:
        from dataclasses import astuple

        from fmus.check import check as run_checks

        out_.announce(file)
        findings = run_checks(_path(file))
        out_.table(str(_path(file)), ("check", "result", "detail"), list(map(astuple, findings)))
        passed = all(f.status != "failed" for f in findings)
        out_.json({"passed": passed, "checks": [vars(f) for f in findings]})
    if not passed:
        raise typer.Exit(1)


@app.command()
def build(
    folder: Annotated[Path | None, typer.Argument(show_default="the evaporator")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o")] = None,
    platforms: Literal["here", "all"] = "here",
    check: Annotated[bool, typer.Option("--check")] = False,
    in_place: Annotated[bool, typer.Option("--in-place")] = False,
    json: JsonOption = False,
) -> None:
    """Build FMUs from C sources: both evaporators, or a plant of your own.

    One of --out, --check and --in-place must be given. With the same compiler the bytes repeat;
    --check exits with code 1 if they differ from those shipped.

    Args:
        folder: Folder with modelDescription.xml and C sources of a plant of your own.
        out: Folder for the FMUs; with FOLDER the .fmu file.
        platforms: here: by the local C compiler ($CC, else cc); all: 64-bit Linux and macOS on x86
            and ARM, Windows on x86, by pip install 'rti-cosim\\[cross]'.
        check: Build for all and compare with the shipped files.
        in_place: Developers: rebuild the shipped files and C header.
    """
    with output(json) as out_:
        from fmus import BuildError
        from fmus.build import build_folder
        from fmus.evaporator import build as build_fmus
        from fmus.evaporator import build_in_place, compare_with_shipped

        every = platforms == "all"
        if (out is not None) + check + in_place != 1:
            raise BuildError("give one of --out DIR, --check and --in-place")
        if folder is not None and (out is None or out.suffix != ".fmu"):
            raise BuildError("an FMU of your own is built by FOLDER --out FILE.fmu")
        if check:
            differing = compare_with_shipped()
            for name, members in differing.items():
                out_.note(f"{name}: {', '.join(members) or 'identical to the one shipped'}")
            out_.json({"identical": not any(differing.values()), "differing": differing})
            if any(differing.values()):
                raise typer.Exit(1)
            return
        if out is None:
            built = build_in_place()
        elif folder is not None:
            writable_folder(out.parent)
            built = [build_folder(folder, out, every_platform=every)]
        else:
            built = build_fmus(writable_folder(out), every_platform=every)
        for path in built:
            out_.note(f"built {path}")
        out_.json({"built": [str(path) for path in built]})
