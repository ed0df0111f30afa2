"""Results as a line at a prompt, a table, a page and a picture; tables as text."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.core.errors import CosimError
from cosim.core.files import write_atomically
from cosim.core.validation import instead

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TextTable = tuple[str, Sequence[str], list[list[str]]]
"""Title, header and rows of texts."""


def csv_text(header: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of texts as CSV, lines ended by one newline.

    Args:
        header: titles of the columns.
        rows: of texts.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return stream.getvalue()


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; the first column is text, the others are numbers.

    Args:
        header: titles of the columns.
        rows: of texts.
    """
    rule = ["---", *["---:"] * (len(header) - 1)]
    text = ""
    for line in (header, rule, *rows):
        text += f"| {' | '.join(line)} |\n"
    return text


def latex_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in LaTeX with the rules of `booktabs`; the first column is text, others are numbers.

    Args:
        header: titles of the columns.
        rows: of texts.
    """
    alignment = "l" + "r" * (len(header) - 1)
    lines = [rf"\begin{{tabular}}{{{alignment}}}", r"\toprule", _latex_line(header), r"\midrule"]
    lines += [_latex_line(row) for row in rows]
    lines += [r"\bottomrule", r"\end{tabular}"]
    return "\n".join(lines) + "\n"


def _latex_line(cells: Sequence[str]) -> str:
    """A row of a LaTeX table; signs that LaTeX reads as commands are escaped."""
    escaped = []
    for cell in cells:
        text = "".join(LATEX_SIGNS.get(sign, sign) for sign in cell)
        # A line that begins with a bracket would be the argument of the line break before.
        escaped.append(f"{{}}{text}" if text.startswith("[") else text)
    return f"{' & '.join(escaped)} \\\\"


LATEX_SIGNS = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "−": "$-$",
    "×": r"$\times$",
    "–": "--",
    "θ": r"$\theta$",
}
for _sign in "&%$#_{}":
    LATEX_SIGNS[_sign] = f"\\{_sign}"


def html_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in HTML.

    Args:
        header: titles of the columns.
        rows: of texts.
    """
    from html import escape  # noqa: PLC0415 - it takes 10 ms of every command's start

    titles = "".join(f"<th>{escape(name)}</th>" for name in header)
    lines = ["<table>", f"<thead><tr>{titles}</tr></thead>", "<tbody>"]
    for row in rows:
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in row)
        lines.append(f"<tr>{cells}</tr>")
    lines += ["</tbody>", "</table>"]
    return "\n".join(lines) + "\n"


TABLE_FORMATS = {
    "markdown": markdown_table,
    "latex": latex_table,
    "html": html_table,
}
"""Writers of a table of texts, by format."""


def text_table(header: Sequence[str], rows: Iterable[Sequence[str]], format: str) -> str:
    """A table of texts in one of `TABLE_FORMATS`.

    Raises:
        CosimError: there is no such format.
    """
    if format not in TABLE_FORMATS:
        raise CosimError(f"a table has no format '{format}'{instead(format, TABLE_FORMATS)}")
    return TABLE_FORMATS[format](header, rows)


def short(value: object) -> str:
    """A value as text; of a float six digits."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


class Shown:
    """An object that shows its facts: a line at a prompt, a table in a notebook."""

    def _facts(self) -> Mapping[str, object]:
        """The facts to show, by label."""
        return {}

    def __repr__(self) -> str:
        facts = []
        for key, value in self._facts().items():
            facts.append(f"{key}={short(value)}")
        return f"{type(self).__name__}({', '.join(facts)})"

    def _repr_html_(self) -> str:
        from html import escape  # noqa: PLC0415 - it takes 10 ms of every command's start

        rows = ""
        for key, value in self._facts().items():
            # A user's name may hold what HTML takes for a tag.
            label = escape(key)
            text = escape(short(value))
            rows += (
                f'<tr><th style="text-align:left">{label}</th>'
                f'<td style="text-align:left">{text}</td></tr>'
            )
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"


class Result(Shown):
    """A measured result, with its figure."""

    def figure(self) -> Figure:
        """The figure of the result."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        buffer = io.BytesIO()
        self.figure().savefig(buffer, format="png", dpi=100)
        # The picture is part of the page, which then needs no other file.
        encoded = base64.b64encode(buffer.getvalue()).decode()
        source = f"data:image/png;base64,{encoded}"
        table = super()._repr_html_()
        return f'{table}<img alt="" style="max-width:100%" src="{source}">'

    def table(self, *, format: str = "markdown") -> str:
        """The facts as a table.

        Args:
            format: markdown, latex or html.
        """
        rows = []
        for key, value in self._facts().items():
            rows.append((key, short(value)))
        header = (type(self).__name__, "value")
        return text_table(header, rows, format)

    def plot(self, path: str | Path) -> Path:
        """Draw `figure` to a PNG or SVG file; raises FigureError on another suffix."""
        from cosim.figures.style import save  # noqa: PLC0415 - matplotlib

        return save(self.figure(), path)

    def report(self, path: str | Path) -> Path:
        """Write one HTML page with the facts and the figure; returns its path."""
        head = f'<!doctype html><meta charset="utf-8"><title>{type(self).__name__}</title>'
        return write_atomically(path, f"{head}\n{self._repr_html_()}\n")
