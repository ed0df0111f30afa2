"""Results as text: a line at a prompt, a table in a notebook; tables as CSV and as Markdown."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path

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
    """What shows its facts: a line at a prompt, a table in a notebook."""

    def _facts(self) -> Mapping[str, object]:
        """What is shown of it, by label."""
        return {}

    def __repr__(self) -> str:
        facts = ", ".join(f"{key}={short(value)}" for key, value in self._facts().items())
        return f"{type(self).__name__}({facts})"

    def _repr_html_(self) -> str:
        """The facts as a table."""
        rows = "".join(
            f'<tr><th style="text-align:left">{escape(key)}</th>'
            f'<td style="text-align:left">{escape(short(value))}</td></tr>'
            for key, value in self._facts().items()
        )
        return f"<table><caption>{type(self).__name__}</caption>{rows}</table>"


def short(value: object) -> str:
    """A value as text; of a float six digits."""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
