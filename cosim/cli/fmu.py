"""`cosim fmu`: what is in an FMU, whether other tools accept it, and the build of ours."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cosim.cli.output import JsonOption, open_folder, output

DIFFERENT = 1

app = typer.Typer(help="Look into an FMU, check it with independent importers, build ours.")

FileArgument = Annotated[
    str, typer.Argument(help="FMU file, or evaporator or evaporator_fmi3 (shipped).")
]


def _path(name: str) -> Path:
    import fmus

    return fmus.path(name) if name in fmus.NAMES else Path(name)


def _short(number: str | None) -> str:
    try:
        return "" if number is None else f"{float(number):.8g}"
    except ValueError:
        return str(number)


@app.command()
def info(file: FileArgument = "evaporator", json: JsonOption = False) -> None:
    """Show an FMU's interfaces, capabilities and variables."""
    with output(json) as out_:
        from dataclasses import asdict

        from fmus.information import information

        found = information(_path(file))
        out_.note(f"{found.path}\nsha256 {found.sha256}\n{found.name}: {found.description}")
        out_.note(f"FMI {found.fmi_version}: {', '.join(found.interfaces)}")
        out_.note(f"offers: {', '.join(found.capabilities) or 'no optional capability'}")
        header = ("variable", "causality", "unit", "start", "min", "max")
        rows = [
            (v.name, v.causality, v.unit or "", *(_short(x) for x in (v.start, v.min, v.max)))
            for v in found.variables
        ]
        out_.table(f"{len(rows)} variables", header, rows)
        out_.json(asdict(found))


@app.command()
def check(file: FileArgument = "evaporator", json: JsonOption = False) -> None:
    """Run an FMU through every independent importer that is installed.

    Exit code 1 if one of them fails. The optional ones: pip install 'rti-cosim\\[fmi-check]'.
    """
    with output(json) as out_:
        from dataclasses import asdict

        from fmus.checks import Status
        from fmus.checks import check as run_checks

        findings = run_checks(_path(file))
        header = ("tool", "check", "result", "detail")
        rows = [(f.tool, f.subject, str(f.status), f.detail) for f in findings]
        out_.table(str(_path(file)), header, rows)
        passed = all(f.status is not Status.FAILED for f in findings)
        out_.json({"passed": passed, "checks": [asdict(f) for f in findings]})
    if not passed:
        raise typer.Exit(DIFFERENT)


@app.command()
def build(
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for the FMUs.", show_default=False)
    ] = None,
    check: Annotated[
        bool,
        typer.Option("--check", help="Build and compare with the shipped files byte for byte."),
    ] = False,
    in_place: Annotated[
        bool,
        typer.Option("--in-place", help="Developers: rebuild the shipped files and C header."),
    ] = False,
    json: JsonOption = False,
) -> None:
    """Build both FMUs from their C sources: needs a C compiler ($CC, else cc).

    One of --out, --check and --in-place must be given. With the same compiler the bytes repeat;
    --check exits with code 1 if they differ from those shipped.
    """
    with output(json) as out_:
        from fmus.build import build as build_fmus
        from fmus.build import build_in_place, compare_with_shipped
        from fmus.errors import BuildError

        if (out is not None) + check + in_place != 1:
            raise BuildError("give one of --out DIR, --check and --in-place")
        if check:
            differing = compare_with_shipped()
            for name, members in differing.items():
                out_.note(f"{name}: {', '.join(members) or 'identical to the one shipped'}")
            out_.json({"identical": not any(differing.values()), "differing": differing})
            if any(differing.values()):
                raise typer.Exit(DIFFERENT)
            return
        built = build_in_place() if out is None else build_fmus(open_folder(out))
        for path in built:
            out_.note(f"built {path}")
        out_.json({"built": [str(path) for path in built]})


@app.command()
def reference(
    file: FileArgument = "evaporator",
    update: Annotated[
        bool, typer.Option("--update", help="Developers: store the signals of FILE anew.")
    ] = False,
    json: JsonOption = False,
) -> None:
    """Compare an evaporator FMU with the stored reference signals, bit for bit.

    Exit code 1 if a signal differs.
    """
    with output(json) as out_:
        from fmus import crosscheck

        if update:
            files = crosscheck.update(_path(file))
            out_.note("\n".join(f"wrote {path}" for path in files))
            out_.json({"written": [str(path) for path in files]})
            return
        found = [str(deviation) for deviation in crosscheck.deviations(_path(file))]
        out_.note("\n".join(found) or f"{len(crosscheck.CASES)} cases, identical")
        out_.json({"identical": not found, "deviations": found})
    if found:
        raise typer.Exit(DIFFERENT)
