"""Results as text: a line at a prompt, a table in a notebook; tables as CSV and as Markdown."""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Table = tuple[str, Sequence[str], list[list[str]]]
"""Title, header and rows of texts."""


def csv_text(header: Sequence[str], rows: Iterable[Iterable[str]]) -> str:
    """A table of texts as CSV, lines ended by one newline."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    return stream.getvalue()


def read_csv(path: str | Path, error: type[Exception]) -> list[list[str]]:
    """Rows of a CSV file, its header first; raises `error` where it cannot be read or is empty."""
    try:
        with Path(path).open(newline="", encoding="utf-8") as stream:
            rows = list(csv.reader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as cause:
        raise error(f"'{path}' cannot be read: {cause}") from None
    if not rows:
        raise error(f"'{path}' is empty")
    return rows


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table; the first column is text, the others are numbers."""
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join(f"| {' | '.join(line)} |" for line in (header, rule, *rows)) + "\n"


class Shown:
    """A result that shows its facts, and its picture where it has one."""

    def _facts(self) -> Mapping[str, object]:
        """What is shown of it, by label."""
        return {}

    def _picture(self) -> Figure | None:
        """The picture below the facts in a notebook."""
        return None

    def __repr__(self) -> str:
        facts = ", ".join(f"{key}={_short(value)}" for key, value in self._facts().items())
        return f"{type(self).__name__}({facts})"

    def _repr_html_(self) -> str:
        """The facts as a table, and the picture."""
        rows = "".join(
            f'<tr><th style="text-align:left">{escape(key)}</th>'
            f'<td style="text-align:left">{escape(_short(value))}</td></tr>'
            for key, value in self._facts().items()
        )
        table = f"<table><caption>{type(self).__name__}</caption>{rows}</table>"
        figure = self._picture()
        if figure is None:
            return table
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=100)
        data = base64.b64encode(buffer.getvalue()).decode()
        return f'{table}<img alt="" style="max-width:100%" src="data:image/png;base64,{data}">'


def _short(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)
