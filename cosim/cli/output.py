"""Shared by commands: options, tables, progress, notes, JSON, the output folder."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from inspect import getdoc
from pathlib import Path
from typing import Annotated, Any

import typer

from cosim.core.errors import CosimError
from cosim.core.files import hold, release, write_atomically
from cosim.core.processes import Terminated, redirected_output
from cosim.core.run_files import RUN_FILES, STUDY_MARKS
from cosim.core.training_options import MOST

MOST_DRAWN = 20_000
"""Samples of the longest run that is drawn: more are a grey band, and take seconds."""
FOLDED_WIDTH = 14
"""Characters that a column of folded texts has at least."""
_made: list[Path] = []
"""Folders that this command has made, each behind the one that it is in."""
LONG_DOCUMENT = 1 << 20
"""Bytes from which on a JSON document is written on one line: what is indented Python writes."""


def count(*names: str, text: str | None = None) -> Any:
    """An option that is a number of samples.

    Args:
        names: of the option, `--steps` say.
        text: of the help; None where the command's docstring has it.
    """
    return typer.Option(*names, min=1, max=MOST, help=text)


def descriptions(documented: object, section: str) -> dict[str, str]:
    """Descriptions of the names in one section of a docstring, on one line each.

    Args:
        documented: what has the docstring.
        section: heading of the section, `Args` or `Attributes`.
    """
    # None where Python drops docstrings (`python -OO`).
    docstring = getdoc(documented) or ""
    _, _, entries = docstring.partition(f"\n\n{section}:\n")
    # `name: words`, up to the next name at the same indentation; the words may go over lines.
    entry = re.compile(r"^ {4}(\w+): (.+?)(?=\n {4}\w|\Z)", re.DOTALL | re.MULTILINE)
    texts = {}
    for name, words in entry.findall(entries):
        texts[name] = " ".join(words.split())
    return texts


ScenarioOption = Annotated[
    str,
    typer.Option("--scenario", "-s", help="Preset (paper, fouled, mismatched, …) or TOML file."),
]
StepsOption = Annotated[int, count("--steps", "-n", text="Number of samples.")]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Seed of the disturbances.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder for the files.")]
OverwriteOption = Annotated[
    bool,
    typer.Option("--overwrite", help="Replace the files of another run that the folder holds."),
]
RecordOption = Annotated[bool, typer.Option("--record", help="Write a Rerun recording too.")]
JobsOption = Annotated[
    int | None,
    typer.Option("--jobs", "-j", min=1, max=1024, help="Processes; default: one per core."),
]
SchedulerOption = Annotated[
    str | None, typer.Option("--scheduler", help="Address of a Dask scheduler, in place of --jobs.")
]
JsonOption = Annotated[
    bool, typer.Option("--json", help="Print a JSON summary on standard output, nothing else.")
]


# A command's tables, its remarks and its JSON all go through this class, so that no command has to
# ask for each line whether it may print it.
class Output:
    """Tables go to standard output, progress to standard error; with JSON, only JSON goes out."""

    def __init__(self, as_json: bool) -> None:
        self.as_json = as_json
        self._stdout: int | None = None

    @property
    def live(self) -> bool:
        """Whether progress is shown: on a terminal, unless JSON was asked for."""
        return not self.as_json and sys.stderr.isatty()

    def note(self, text: str) -> None:
        """Print a line on standard error, above a bar, unless JSON was asked for."""
        if not self.as_json:
            # A bar that is being drawn turns standard error to itself.
            print(text, file=sys.stderr)

    def legend(self, text: str) -> None:
        """Print a line on the table above to where that went, unless JSON was asked for."""
        if not self.as_json:
            _print(text)

    def entries(self, title: str, entries: Sequence[tuple[str, str]]) -> None:
        """Print entries, each a line with its text indented below, unless JSON was asked for.

        Args:
            title: a line above them.
            entries: the line and the text of each.
        """
        if self.as_json:
            return
        from textwrap import fill

        width = shutil.get_terminal_size().columns
        lines = [title]
        for heading, text in entries:
            lines.append(fill(heading, width, initial_indent="  ", subsequent_indent="    "))
            lines.append(fill(text, width, initial_indent="      ", subsequent_indent="      "))
        _print("\n".join(lines))

    def table(
        self,
        title: str,
        header: Sequence[str],
        rows: Sequence[Sequence[str]],
    ) -> None:
        """Print a table, columns of numbers right justified and the others left.

        It is as wide as the terminal, or 80 characters in a file or pipe; `COLUMNS` changes that.
        Wide texts are folded. Columns that do not fit go to further tables below, each with the
        first column.

        Args:
            title: a line above it.
            header: titles of the columns.
            rows: of texts, one for each column.
        """
        if self.as_json:
            return
        from rich.console import Console
        from rich.markup import escape
        from rich.table import Table

        console = Console()
        columns: list[list[str]] = []
        widths: list[int] = []
        folded: list[bool] = []
        for number, name in enumerate(header):
            cells = [row[number] for row in rows]
            columns.append(cells)
            # A heading may be folded, but that of the first column.
            words = name.split() if widths else [name]
            # So may texts of several words, but no number with its interval.
            may_fold = bool(widths) and not all(_is_number(cell) for cell in cells)
            folded.append(may_fold)
            for cell in cells:
                words += cell.split() if may_fold else [cell]
            longest = max((len(word) for word in words), default=0)
            if may_fold:
                # As wide as its cells need, but no wider than a column of short lines.
                widest_cell = max((len(cell) for cell in cells), default=0)
                longest = max(longest, min(widest_cell, FOLDED_WIDTH))
            # A border, and a space on either side.
            widths.append(longest + 3)
        for part in _fitting_tables(widths, console.width - 1):
            width = min(len(title), console.width)
            # The room that the table takes with nothing folded.
            full_width = 1
            for number in part:
                full_width += 3 + max(len(text) for text in [header[number], *columns[number]])
            fits = full_width <= console.width
            table = Table(title=escape(title), title_justify="left", min_width=width)
            for number in part:
                is_numeric = all(_is_number(cell) for cell in columns[number])
                justify: Any = "right" if is_numeric else "left"
                heading = escape(header[number])
                # The widest texts have the room that the other columns leave.
                is_widest = number == _widest(part, columns, folded)
                table.add_column(
                    heading,
                    justify=justify,
                    overflow="fold",
                    no_wrap=not folded[number] and number == part[0],
                    min_width=widths[number] - 3,
                    max_width=None if is_widest or fits else widths[number] - 3,
                )
            for row in rows:
                # Rich would read `[X2]` as a style.
                cells = [escape(row[number]) for number in part]
                table.add_row(*cells)
            console.print(table)

    def json(self, document: Mapping[str, Any]) -> None:
        """Print the document if JSON was asked for."""
        if not self.as_json:
            return
        text = dump(document)
        if self._stdout is None:
            sys.stdout.write(text)
        else:
            # Standard output itself is turned away from native code meanwhile (`output`).
            os.write(self._stdout, text.encode())

    def announce(self, fmu: str) -> None:
        """Say which FMU's native code is about to run, unless it is a shipped one."""
        from cosim.plant.fmi import SHIPPED_FMUS, unpack

        # A shipped one is built from the sources of this package.
        if fmu not in SHIPPED_FMUS:
            unpacked = unpack(fmu)
            self.note(f"native code of {unpacked.path}, sha256 {unpacked.sha256}")


def _print(text: str) -> None:
    """Print text as it is where tables go; a reader that leaves ends the command as theirs does."""
    from rich.console import Console

    Console().print(text, markup=False, highlight=False, soft_wrap=True)


def _fitting_tables(widths: Sequence[int], room: int) -> list[list[int]]:
    """Columns by table, so that each table fits the room if it can; all have the first column."""
    # Little would fit beside such a first column.
    if widths[0] > room / 2:
        return [list(range(len(widths)))]
    tables = [[0]]
    used = widths[0]
    for column in range(1, len(widths)):
        # A table has one column beside the first, be it too wide.
        has_another = len(tables[-1]) > 1
        if has_another and used + widths[column] > room:
            tables.append([0])
            used = widths[0]
        tables[-1].append(column)
        used += widths[column]
    return tables


def _widest(part: Sequence[int], columns: Sequence[Sequence[str]], folded: Sequence[bool]) -> int:
    """The column of a table that has the longest texts; −1 where none may be folded."""
    longest = 0
    widest = -1
    for number in part:
        if not folded[number]:
            continue
        for cell in columns[number]:
            if len(cell) > longest:
                longest = len(cell)
                widest = number
    return widest


def _is_number(cell: str) -> bool:
    """Whether a cell begins with a number, or is empty."""
    # A dash says that there is none.
    if cell.strip() in ("", "–"):
        return True
    # An interval stands behind its value: `1.2 [1.1, 1.3]`.
    first, *_ = cell.split()
    try:
        float(first.strip("()[],"))
    except ValueError:
        return False
    return True


@contextmanager
def output(as_json: bool) -> Iterator[Output]:
    """Open a command's output; its folders' locks are released at the end.

    Folders that the command made and left empty, as one that was refused does, go.

    With JSON, file descriptor 1 is turned to standard error meanwhile, since an FMU or a solver
    is native code that may print.
    """
    result = Output(as_json)
    redirection = redirected_output() if as_json else nullcontext(None)
    with redirection as result._stdout:
        try:
            yield result
        finally:
            release()
            while _made:
                # None that holds a file, or another process's lock, can be removed.
                with suppress(OSError):
                    _made.pop().rmdir()


@contextmanager
def resumable(
    how: Callable[[], str] = lambda: (
        "what is finished is kept: the same command goes on from there"
    ),
) -> Iterator[None]:
    """On interruption or termination, print `how` to continue, unless it is empty."""
    try:
        yield
    except (KeyboardInterrupt, Terminated) as error:
        words = how()
        # `main` prints the notes behind "interrupted", when all is unwound.
        if words:
            error.add_note(words)
        raise


@contextmanager
def followed(
    out: Output,
    label: str,
    samples: int,
) -> Iterator[Callable[[int, str, str], None]]:
    """The `progress` of resumable work: a bar, and a line for each event.

    Args:
        out: of the command.
        label: what the bar is called.
        samples: of the whole work.

    Yields:
        What is called with the samples done, the runs done in words, and a line about an event,
        or "".
    """
    from cosim.core.simulation import reporting

    with resumable(), reporting(out.live, label, samples) as bar:

        def tell(n_done: int, runs: str, line: str) -> None:
            bar(n_done, runs)
            if line:
                text = f"{runs}  {line}"
                out.note(text.strip())

        yield tell


def write_summary(folder: Path, document: Mapping[str, Any]) -> None:
    """Write summary.json.

    Args:
        folder: where it goes.
        document: numbers, words, lists and tables.
    """
    text = dump(document)
    write_atomically(folder / "summary.json", text)


def dump(document: Mapping[str, Any]) -> str:
    """JSON text with sorted keys, on one line if long; non-finite numbers become null."""
    from pydantic_core import to_json

    # Pydantic's knows NumPy's numbers and paths, Python's sorts the keys.
    unsorted = to_json(dict(document), inf_nan_mode="null")
    plain = json.loads(unsorted)
    is_long = len(unsorted) >= LONG_DOCUMENT
    indent = None if is_long else 2
    text = json.dumps(plain, indent=indent, sort_keys=True)
    return f"{text}\n"


def open_folder(
    folder: Path,
    overwrite: bool,
    instead: str = "replace it by --overwrite",
) -> Path:
    """The folder of a run: a `writable_folder`, held, absolute since an FMU may change directories.

    Args:
        folder: `--out`.
        overwrite: whether files of another run may be replaced.
        instead: what the user may do where the folder holds such files.

    Raises:
        CosimError: before the work, where another process holds it, or it holds another run.
    """
    hold(writable_folder(folder))
    study = _first_of(folder, STUDY_MARKS)
    # It may have taken days, and no single run replaces all of it.
    if study:
        raise CosimError(f"folder '{folder}' holds a study ({study}): choose another --out")
    file = _first_of(folder, RUN_FILES)
    if file and not overwrite:
        raise CosimError(
            f"folder '{folder}' holds another run ({file}): {instead}, or choose another --out"
        )
    return folder.absolute()


def open_study_folder(folder: Path) -> Path:
    """The folder of a study, as `open_folder` has it; a study goes on in its own.

    Raises CosimError where another process holds it, or it holds a run that is no study.
    """
    hold(writable_folder(folder))
    # Its own scenarios may lie there: no study writes scenario.toml.
    file = _first_of(folder, [name for name in RUN_FILES if name != "scenario.toml"])
    if file and not _first_of(folder, STUDY_MARKS):
        raise CosimError(
            f"folder '{folder}' holds a run that is no study ({file}): choose another --out"
        )
    return folder.absolute()


def _first_of(folder: Path, patterns: Sequence[str]) -> str:
    """Name of the first file in a folder that a pattern fits; empty where none does."""
    for pattern in patterns:
        for path in folder.glob(pattern):
            return str(path.relative_to(folder))
    return ""


def split_names(text: str) -> list[str]:
    """Words of a comma-separated option; a comma in brackets or quotes is a name's: `A[1,2]`."""
    # Quoted, in brackets or in parentheses; else any sign but a comma.
    words = re.findall(r"(?:'[^']*'|\[[^\]]*\]|\([^)]*\)|[^,])+", text)
    stripped = [word.strip() for word in words]
    return [word for word in stripped if word]


def writable_folder(folder: Path) -> Path:
    """Create a folder and make sure, before the work, that it can be written."""
    missing = [path for path in folder.absolute().parents if not path.exists()]
    missing.reverse()
    if not folder.exists():
        missing.append(folder.absolute())
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _made.extend(missing)
        # Permissions do not tell all: a disk may be full, or mounted for reading alone.
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".cosim-"):
            pass
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise CosimError(f"cannot write to folder '{folder}': {reason}") from None
    return folder
