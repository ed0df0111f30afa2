"""What a measurement's result can do: a table, a page and a picture."""

from __future__ import annotations

import base64
import io
from pathlib import Path
from typing import TYPE_CHECKING

from cosim.files import write_atomically
from cosim.text_tables import Shown, markdown_table, short

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Result(Shown):
    """What was measured, with its figure."""

    def figure(self) -> Figure:
        """The figure of the result."""
        raise NotImplementedError

    def _repr_html_(self) -> str:
        """The facts as a table, and the figure."""
        buffer = io.BytesIO()
        self.figure().savefig(buffer, format="png", dpi=100)
        source = f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"
        return f'{super()._repr_html_()}<img alt="" style="max-width:100%" src="{source}">'

    def table(self) -> str:
        """The facts as a Markdown table."""
        rows = [(key, short(value)) for key, value in self._facts().items()]
        return markdown_table((type(self).__name__, "value"), rows)

    def plot(self, path: str | Path) -> Path:
        """Draw `figure` to a PNG or SVG file; raises FigureError where it cannot be written."""
        from cosim.figures.style import save  # noqa: PLC0415 - matplotlib

        return save(self.figure(), path)

    def report(self, path: str | Path) -> Path:
        """Write one HTML page with the facts and the figure; returns its path."""
        head = f'<!doctype html><meta charset="utf-8"><title>{type(self).__name__}</title>'
        return write_atomically(path, f"{head}\n{self._repr_html_()}\n")
