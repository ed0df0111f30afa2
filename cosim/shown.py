"""How results show themselves: one line at a prompt, a table with a picture in a notebook."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from html import escape
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Shown:
    """A result that shows its facts, and its picture where it has one."""

    def _facts(self) -> Mapping[str, object]:
        """What is shown of it, by label."""
        return {}

    def _picture(self) -> Figure | None:
        """The picture below the facts in a notebook."""
        return None

    def __repr__(self) -> str:
        """The facts in one line."""
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
