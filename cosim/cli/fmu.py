"""`cosim fmu`: the contents of an FMU, its check, and the build of the shipped ones."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from cosim.cli.output import JsonOption, output, split_names, writable_folder

MOST_ROWS = 1000
"""Variables of a table at most: a table of 200 000 takes minutes to print."""

fmu_app = typer.Typer(help="Inspect an FMU, check it, or build one.")

FmuFileArgument = Annotated[str, typer.Argument()]


def _path(name: str) -> Path:
    import fmus

    shipped = (*fmus.NAMES, *fmus.PLANTS)
    return fmus.path(name) if name in shipped else Path(name)


@fmu_app.command("info")
def show_fmu(file: FmuFileArgument = "evaporator", json: JsonOption = False) -> None:
    """Show an FMU's interfaces, platforms, flags and variables, and why it cannot be a plant.

    Args:
        file: FMU file, or the name of a shipped one, such as evaporator_fmi3 or tanks.
    """
    with output(json) as out_:
        from cosim.core.errors import PlantError
        from cosim.plant.fmi import unpack
        from cosim.plant.wiring import refusals
        from fmus.check import information

        try:
            unpacked = unpack(_path(file))
            description = unpacked.description
            refused = list(refusals(unpacked))
        # What cannot be a plant can still be looked into.
        except PlantError as error:
            description = None
            refused = [str(error)]
        about = information(_path(file), description)
        binaries = []
        for platform, made_for in about["platforms"].items():
            # Sources are made for no platform.
            if made_for:
                binaries.append(f"{platform} ({', '.join(made_for)})")
            else:
                binaries.append(platform)
        interfaces = about["flags"]
        out_.note(about["path"])
        out_.note(f"sha256 {about['sha256']}")
        out_.note(f"{about['name']}: {about['description']}")
        out_.note(f"FMI {about['fmi_version']}: {', '.join(interfaces)}")
        out_.note(f"binaries: {', '.join(binaries)}")
        for reason in refused:
            out_.note(f"no plant: {reason}")
        if not refused:
            out_.note("the plant accepts it")
        out_.table("capability flags", ("flag", *interfaces), _flag_rows(interfaces))
        header = ("name", "causality", "unit", "start", "min", "max")
        rows = []
        for variable in about["variables"][:MOST_ROWS]:
            rows.append([str(variable[key] or "") for key in header])
        count = len(about["variables"])
        title = f"{count} variables"
        if count > MOST_ROWS:
            title += f", the first {MOST_ROWS} here, all with --json"
        out_.table(title, header, rows)
        out_.json(about | {"refusals": refused})


def _flag_rows(interfaces: Mapping[str, Mapping[str, str]]) -> list[list[str]]:
    """A row for each capability flag, a column for each interface; a dash where it states none."""
    # In the order of the file; a dictionary keeps it, and each name once.
    names: dict[str, None] = {}
    for flags in interfaces.values():
        names |= dict.fromkeys(flags)
    rows = []
    for name in names:
        row = [name]
        for flags in interfaces.values():
            row.append(flags.get(name, "–"))
        rows.append(row)
    return rows


@fmu_app.command("check")
def check_fmu(
    file: FmuFileArgument = "evaporator",
    states: str = "",
    actions: str = "",
    cost: str | None = None,
    sampling_time: Annotated[float | None, typer.Option(min=1e-9, max=1e12)] = None,
    model: Annotated[str | None, typer.Option("--model", "-m")] = None,
    scenario: Annotated[str | None, typer.Option("--scenario", "-s")] = None,
    points: Annotated[int | None, typer.Option(min=1, max=100_000)] = None,
    seed: Annotated[int | None, typer.Option(min=0)] = None,
    tolerance: Annotated[float | None, typer.Option(min=1e-15, max=1e3)] = None,
    json: JsonOption = False,
) -> None:
    """Check by trials whether an FMU can be a plant.

    The table has checks, findings and consequences; the last line is the verdict. Exit code 0: the
    FMU can be a plant; 1: it cannot; 2: there is no such FMU. The check runs the FMU's native code.

    With --model, the FMU is compared with a controller's model at random points. The table has the
    largest difference of next states, cost and outputs, and its place. Exit code 0: both agree;
    1: they do not; 2: bad input.

    Args:
        file: FMU file, or the name of a shipped one, such as evaporator_fmi3 or tanks.
        model: Model to compare with, module:factory.
        scenario: With --model: the scenario that names the variables and bounds the points.
        points: With --model: number of points; default 100.
        seed: With --model: seed of the points; default 0.
        tolerance: With --model: largest difference, as a share of the quantity's variation;
            default 0.001.
        states: Names, comma-separated; default: those that `scenario init` guesses.
        actions: Names, comma-separated.
        cost: Output that is the stage cost.
        sampling_time: Sampling time in s.
    """
    if model is not None:
        _compare_with_model(
            file,
            model,
            json,
            scenario=scenario,
            states=split_names(states),
            actions=split_names(actions),
            stage_cost=cost,
            sampling_time=sampling_time,
            points=100 if points is None else points,
            seed=0 if seed is None else seed,
            tolerance=1e-3 if tolerance is None else tolerance,
        )
        return
    with output(json) as out_:
        from cosim.core.errors import CosimError, FmuWarning, PlantError
        from cosim.plant.check import PlantCheck, check_plant

        if (scenario, points, seed, tolerance) != (None,) * 4:
            raise CosimError("--scenario, --points, --seed and --tolerance go with --model")
        path = Path(file).absolute()
        try:
            with warnings.catch_warnings():
                # The table says the same.
                warnings.simplefilter("ignore", FmuWarning)
                outcome = check_plant(
                    file,
                    states=split_names(states),
                    actions=split_names(actions),
                    stage_cost=cost,
                    sampling_time=sampling_time,
                )
        # Of a file that is there this is the answer, and no error.
        except PlantError as error:
            if not path.is_file():
                raise
            outcome = PlantCheck(path, False, f"it cannot be a plant: {error}", ())
        header = ("checked", "found", "what follows")
        rows = []
        for row in outcome.rows:
            rows.append((row.subject, row.finding, row.consequence))
        if rows:
            out_.table(str(outcome.fmu), header, rows)
        if outcome.remarks:
            remarks = [(remark,) for remark in outcome.remarks[:MOST_ROWS]]
            out_.table("remarks on the model description", ("remark",), remarks)
        if not json:
            print(outcome.verdict)
        out_.json(outcome.to_dict())
    if not outcome.usable:
        raise typer.Exit(1)


def _compare_with_model(file: str, model: str, json: bool, **options: Any) -> None:
    """Print the differences between an FMU and a model; exit code 1 where they do not agree."""
    with output(json) as out_:
        from cosim.model_check import check_model

        outcome = check_model(file, model, **options)
        for remark in outcome.remarks:
            out_.note(f"remark: {remark}")
        if not json:
            for difference in outcome.differences:
                print(difference)
            print(outcome.verdict)
        out_.json(outcome.to_dict())
    if not outcome.agrees:
        raise typer.Exit(1)


@fmu_app.command("build")
def build_fmu(
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
        from fmus.evaporator import build_evaporator as build_fmus
        from fmus.evaporator import build_in_place, compare_with_shipped

        every = platforms == "all"
        # None of them is a default: two of three would replace files.
        if (out is not None) + check + in_place != 1:
            raise BuildError("give one of --out DIR, --check and --in-place")
        if folder is not None and (out is None or out.suffix != ".fmu"):
            raise BuildError("an FMU of your own is built by FOLDER --out FILE.fmu")
        if check:
            differing = compare_with_shipped()
            for name, members in differing.items():
                out_.note(f"{name}: {', '.join(members) or 'identical to the one shipped'}")
            identical = not any(differing.values())
            out_.json({"identical": identical, "differing": differing})
            if not identical:
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
        paths = [str(path) for path in built]
        out_.json({"built": paths})
