"""The application, its commands, and the handling of errors."""

from __future__ import annotations

import os
import re
import sys
import traceback
import warnings
from collections.abc import Callable
from inspect import getdoc
from itertools import pairwise
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from cosim.cli import (
    compare,
    demo,
    evaluate,
    export,
    fmu,
    new,
    optimum,
    scenario,
    shadow,
    simulate,
    study,
    train,
    view,
)
from cosim.cli.output import descriptions
from cosim.core.errors import CosimError, CosimWarning
from cosim.core.files import protect
from cosim.core.modules import users_place
from cosim.core.processes import Interrupted, Terminated, command_process, unwound

OUTPUT_OPTIONS = ("--out", "-o", "--png", "--ssp", "--record")
"""Options whose value is an output path."""

OPTIONS_OF_PANELS = {
    "Files and output": ("out", "overwrite", "plot", "record", "png", "ssp", "json"),
    "Log and evaluation": (
        "log_every", "evaluate_every", "checkpoint_every", "divergence", "resume",
        "evaluation_seeds", "evaluation_steps",
    ),
    "Workers": ("jobs", "scheduler"),
}  # fmt: skip
"""Options that the help shows in a panel of their own; the others are under Options."""
PANELS = {name: panel for panel, names in OPTIONS_OF_PANELS.items() for name in names}


def _help_text(command: object) -> str:
    """Help text of a command: its docstring up to the arguments, a paragraph a line."""
    text = (getdoc(command) or "").partition("\n\nArgs:\n")[0]
    # A terminal breaks the lines where it ends.
    paragraphs = [paragraph.replace("\n", " ") for paragraph in text.split("\n\n")]
    return "\n\n".join(paragraphs)


class _Commands(TyperGroup):
    """Command group; refuses empty arguments."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Refuse empty words: as a path, one would mean the working directory; protect inputs.

        Args:
            ctx: Click's context.
            args: words of the command line.
        """
        inputs: list[str] = []
        for before, word in pairwise(["", *args]):
            # A value stands behind its option, or with it: `--out DIR`, `--out=DIR`.
            name, equals, value = word.partition("=")
            is_empty_value = name.startswith("--") and bool(equals) and not value
            if not word and before.startswith("-"):
                name = before
            if not word or is_empty_value:
                what = f"the value of '{name}'" if name else "an argument"
                raise CosimError(f"{what} is empty: give one, or leave it out")
            is_output = before in OUTPUT_OPTIONS or name in OUTPUT_OPTIONS
            if not is_output:
                # Any word may name a file that is read, alone or in a list of names.
                inputs += [word, *re.split("[,=]", word)]
        protect(inputs)
        # Completion says what the help says.
        if ctx.resilient_parsing or "-h" in args or "--help" in args:
            self._describe_options()
        return super().parse_args(ctx, args)

    def _describe_options(self) -> None:
        """Give each option of each command its text and its panel: only the help shows them."""
        import typer.rich_utils

        # [1<=x<=100000000] takes a narrow terminal's room.
        typer.rich_utils.RANGE_STRING = ""
        commands: list[Any] = [*self.commands.values()]
        # A group's own commands are put behind it, and come in their turn.
        for command in commands:
            commands += getattr(command, "commands", {}).values()
            described = descriptions(command.callback, "Args")
            for option in command.params:
                option.rich_help_panel = PANELS.get(option.name, option.rich_help_panel)
                option.help = described.get(option.name, option.help)

    def invoke(self, ctx: Any) -> Any:
        """Let Ctrl-C through, which Typer would end without a word."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt as error:
            raise Interrupted(*getattr(error, "__notes__", [])) from None
        except BrokenPipeError:
            raise CosimError("a pipe that the command, or a plug-in, writes to is closed") from None
        except SystemExit as error:
            if isinstance(error.__context__, BrokenPipeError):  # the reader of our own output left
                raise SystemExit(EXIT_CLOSED_PIPE) from None
            raise CosimError(f"a plug-in ended the command by exit({error.code})") from error


app = typer.Typer(
    name="cosim",
    cls=_Commands,
    help="Co-simulate an FMU plant with learning-based MPC, and benchmark what it learns.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    epilog="Example: cosim demo --out demo",
    context_settings={"help_option_names": ["-h", "--help"]},
)
LOOK = "A first look"
COMPARE = "Compare rules and controllers"
PLANT = "Control your own plant"
CHECK = "Check the claims"
for panel, function, example in (
    (LOOK, demo.demo, "demo --out demo"),
    (
        LOOK,
        simulate.simulate,
        "simulate --scenario paper --controller tuned --steps 500 --record",
    ),
    (
        COMPARE,
        evaluate.evaluate,
        "evaluate --scenario fouled --controllers naive,tuned --seeds 10",
    ),
    (
        PLANT,
        shadow.shadow,
        "shadow cautious --data cosim-run/trajectory.csv --scenario fouled",
    ),
    (COMPARE, train.train, "train --algorithm q-learning --samples 20000 --out learned"),
    (LOOK, view.view, "view cosim-run/run.rrd --png run.png"),
    (COMPARE, compare.compare, "compare cosim-run other-run --relative 1e-9"),
    (COMPARE, optimum.optimum, "optimum --scenario paper"),
    (PLANT, optimum.tuning, "tuning --scenario paper --out tuned.toml"),
    (COMPARE, new.new, "new rule my_rule"),
    (PLANT, export.export, "export tuned --out controller.fmu --ssp loop.ssp"),
    (CHECK, study.reproduce, "reproduce --budget quick --out reproduction"),
):
    epilog = f"Example: cosim {example}"
    app.command(rich_help_panel=panel, help=_help_text(function), epilog=epilog)(function)
for panel, group, name, *examples in (
    (PLANT, scenario.scenario_app, "scenario", "show fouled", "init mine.fmu --out mine.toml"),
    (
        COMPARE,
        study.study_app,
        "study",
        "run mine.toml --out study",
        "plan mine.toml",
        "report study",
    ),
    (
        CHECK,
        study.results_app,
        "results",
        "check quick",
        "update quick",
        "report quick",
        "draw quick",
    ),
    (PLANT, fmu.fmu_app, "fmu", "info mine.fmu", "check mine.fmu", "build plant --out plant.fmu"),
):
    texts = [f"Example: cosim {name} {example}" for example in examples]
    app.add_typer(group, name=name, rich_help_panel=panel, epilog=texts[0])
    for command, text in zip(group.registered_commands, texts, strict=True):
        command.help = _help_text(command.callback)
        command.epilog = text

# 2 is what Typer exits with on a wrong option, 70 sysexits' EX_SOFTWARE; a process that a signal
# ends has 128 + the signal's number in a shell.
EXIT_BAD_INPUT = 2
EXIT_UNFORESEEN = 70
EXIT_INTERRUPTED = 130
EXIT_CLOSED_PIPE = 141
EXIT_TERMINATED = 143


def _version(wanted: bool) -> None:
    # Typer calls it without the option, too.
    if not wanted:
        return
    import hashlib
    from importlib.metadata import version

    import fmus
    from controllers.functions import description

    print(f"cosim {version('rti-cosim')}")
    for name in ("evaporator", "evaporator_fmi3"):
        digest = hashlib.sha256(fmus.path(name).read_bytes()).hexdigest()
        print(f"{name}.fmu sha256 {digest}")
    print(f"functions of long runs: {description()}")
    raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_version,
            is_eager=True,
            help="Print the version, the shipped FMUs' hashes and how functions are computed.",
        ),
    ] = False,
) -> None:
    """Co-simulate an FMU plant with learning-based MPC, and benchmark what it learns."""


def main() -> None:
    """Run the command line.

    Bad input, and a mistake in a plug-in, end in one line on standard error and exit code 2. An
    unforeseen error ends in one line, a report with the traceback and exit code 70.
    """
    # NumPy's import starts BLAS's threads: 15 % of a short run's time, and of no use to small
    # matrices.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    _open_streams()
    warnings.formatwarning = _format_warning
    with command_process():
        _run_app()


def _format_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    line: str | None = None,
    *,
    default: Callable[..., str] = warnings.formatwarning,
) -> str:
    """One line of our own warnings; those of others as Python has them."""
    if issubclass(category, CosimWarning):
        return f"warning: {' '.join(str(message).split())}\n"
    return default(message, category, filename, lineno, line)


def _open_streams() -> None:
    """Make both standard streams writable, closed ones too.

    A character that a stream's encoding lacks is written as its escape; a closed stream drops its
    text.
    """
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115, PTH123
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _run_app() -> None:
    """Run the application; any exception ends in its line and exit code."""
    try:
        app()
    # A command's own exit code: 1 says that the answer is no, as of `diff`.
    except SystemExit:
        raise
    except (Interrupted, Terminated) as error:
        unwound.set()
        # The notes say how to go on (`cosim.cli.output.resumable`).
        if isinstance(error, Interrupted):
            print("; ".join(["interrupted", *error.args]), file=sys.stderr)
            sys.exit(EXIT_INTERRUPTED)
        print("; ".join(["terminated", *getattr(error, "__notes__", ())]), file=sys.stderr)
        sys.exit(EXIT_TERMINATED)
    except BaseException as error:
        # Libraries raise other errors over it, and the cross compiler has its own word for it.
        if re.search("Too many open files|FdQuota", "".join(traceback.format_exception(error))):
            _fail("too few files may be open at a time: raise the limit, by ulimit -n 1024 say")
        if isinstance(error, MemoryError):
            _fail(f"not enough memory ({error}); ask for fewer samples")
        if isinstance(error, ModuleNotFoundError):  # of a plug-in it is an error of its own
            if error.name in ("rerun", "pyarrow"):
                _fail("the viewer of recordings is not installed: pip install 'rti-cosim[view]'")
            _fail(f"the package '{error.name}' is not installed: pip install {error.name}")
        if isinstance(error, OSError):
            name = f"'{error.filename}': " if error.filename else ""
            _fail(f"{name}{error.strerror or error}")
        if isinstance(error, CosimError):
            _fail(str(error))
        # The user's own code is the user's to mend.
        place = users_place(error)
        if place:
            _fail(f"{place}: {type(error).__name__}: {error}")
        _report(error)


def _fail(message: str) -> None:
    # A message of a library may have several lines.
    one_line = " ".join(message.split())
    print(f"error: {one_line}", file=sys.stderr)
    sys.exit(EXIT_BAD_INPUT)


def _report(error: BaseException) -> None:
    """Write the traceback to a file and print one line with its path."""
    import tempfile
    from importlib.metadata import version

    with tempfile.NamedTemporaryFile(
        "w", prefix="cosim-report-", suffix=".txt", delete=False, encoding="utf-8"
    ) as file:
        print(f"rti-cosim {version('rti-cosim')}, Python {sys.version}, {sys.platform}", file=file)
        print(f"arguments: {sys.argv[1:]}\n", file=file)
        traceback.print_exception(error, file=file)
    text = " ".join(f"{type(error).__name__}: {error}".split())
    print(
        f"error: unforeseen, a mistake in cosim: {text}; the report is in "
        f"{file.name}: please send it to the maintainers with the command",
        file=sys.stderr,
    )
    sys.exit(EXIT_UNFORESEEN)
