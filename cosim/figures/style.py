"""The look of every figure, and writing it so that the same data give the same bytes."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from cosim.errors import FigureError
from cosim.files import write_atomically

WIDTH = 7.16
"""Width of a two-column figure in inches, as journals print it."""

SERIES = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
BOUND = "#B2182B"
REFERENCE = "#5A6570"
_KNOWN = {
    "naive": "#7F7F7F",
    "tuned": "#E69F00",
    "converged": "#CC79A7",
    "optimal": "#111111",
    "learned": "#0072B2",
}

_STYLE: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 8.0,
    "mathtext.fontset": "dejavusans",
    "axes.titlesize": 8.5,
    "axes.labelsize": 8.0,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E8EC",
    "grid.linewidth": 0.6,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "legend.fontsize": 7.0,
    "legend.frameon": False,
    "lines.linewidth": 1.0,
    "figure.dpi": 100,
    "svg.hashsalt": "rti-cosim",
    "svg.fonttype": "path",
}


@contextmanager
def figure(height: float, width: float = WIDTH) -> Iterator[Figure]:
    """A figure of the house style, in inches, without touching the user's own settings."""
    with _styled():
        yield Figure(figsize=(width, height), layout="constrained")


@contextmanager
def _styled() -> Iterator[None]:
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(_STYLE)
        yield


def save(drawn: Figure, path: str | Path) -> Path:
    """Write a figure as PNG (200 dpi) or SVG, by the path's suffix; same figure, same bytes.

    Raises
    ------
    FigureError : another suffix, or a folder that cannot be written.
    """
    path = Path(path)
    kind = path.suffix.removeprefix(".")
    if kind not in ("png", "svg"):
        raise FigureError(f"cannot draw '{path}': the file must end in .png or .svg")
    content = io.BytesIO()
    FigureCanvasAgg(drawn)
    with _styled():
        # The SVG writer adds the date unless told not to.
        metadata = {"Date": None} if kind == "svg" else {"Software": "rti-cosim"}
        drawn.savefig(content, format=kind, dpi=200, metadata=metadata)
    try:
        write_atomically(path, content.getvalue())
    except OSError as error:
        raise FigureError(f"cannot write '{path}': {error.strerror}") from None
    return path


def colors(names: Sequence[str]) -> Mapping[str, str]:
    """A colour for each controller: the known ones have their own, the others what is left.

    A known one's colour goes to another only if it is absent, and after all colours of nobody.
    """
    taken = {_KNOWN.get(name) for name in names}
    left = [color for color in SERIES if color not in taken]
    others = cycle(sorted(left, key=lambda color: color in _KNOWN.values()))
    return {name: _KNOWN.get(name) or next(others) for name in names}


def plain(text: str) -> str:
    """The user's text, kept from being read as mathematics."""
    return text.replace("$", r"\$")


def symbol(name: str) -> str:
    """`B_Vf` as mathematics, B with the block's subscript."""
    head, _, subscript = name.partition("_")
    if not head.isalpha() or "$" in name:
        return plain(name)
    known = {"lambda": r"\lambda", "sigma": r"\sigma", "Vf": r"V^\mathrm{f}"}
    # The stage cost's blocks are set with ℓ; x_l is the lower bound.
    if head in ("B", "b"):
        known["l"] = r"\ell"
    return f"${head}_{{{known.get(subscript, subscript)}}}$" if subscript else f"${head}$"


def label(name: str, unit: str) -> str:
    """Axis label `name [unit]`; `X2` prints with its digits as a subscript."""
    head = name.rstrip("0123456789")
    digits = name[len(head) :]
    symbol = (
        f"${head}_{{{digits}}}$" if digits and head.isalpha() else plain(name.replace("_", " "))
    )
    shown = plain({"degC": "°C", "1": ""}.get(unit, unit))
    return f"{symbol} [{shown}]" if shown else symbol


def limit(axes: Axes, value: float, text: str = "") -> None:
    """Draw a bound across the axes, named right of them: within, the data would hide it."""
    axes.axhline(value, color=BOUND, linewidth=1.0, linestyle=(0, (4, 2)), zorder=3)
    if text:
        axes.annotate(
            text,
            (1.0, value),
            xycoords=("axes fraction", "data"),
            xytext=(3, 0),
            textcoords="offset points",
            ha="left",
            va="center",
            fontsize=6.5,
            color=BOUND,
        )


def legend_above(axes: Axes, columns: int = 2, title: str = "") -> None:
    """Put the legend over the axes, where it hides no data."""
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=columns,
        borderaxespad=0.2,
        handlelength=1.4,
        title=title,
        title_fontsize=8.5,
        alignment="left",
    )
