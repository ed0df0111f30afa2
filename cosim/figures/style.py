"""The look of every figure: colours, axes, names at the ends of lines, and byte-stable files."""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from colorsys import hls_to_rgb, rgb_to_hls
from contextlib import contextmanager
from itertools import cycle, product
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, FormatStrFormatter
from numpy.typing import NDArray

from cosim.errors import FigureError
from cosim.files import write_atomically

WIDTH = 7.16
"""Width of a two-column figure in inches, as journals print it."""
FLOOR = 0.01
"""Regret in % below which an axis is linear."""

ENTRIES = tuple(map(to_hex, mpl.colormaps["viridis"](np.linspace(0.0, 0.88, 6))))
"""Colours of θ's blocks and entries, none of which is a controller's."""
BOUND = "#B2182B"
REFERENCE = "#5A6570"
INK = "#222222"
END_SIZE = 6.5
DASHED: Any = (0, (4, 2))
_KNOWN = {
    "naive": "#7F7F7F", "tuned": "#E69F00", "converged": "#CC79A7", "optimal": "#111111",
    "q-learning": "#0072B2", "batch-q-learning": "#009E73", "actor-critic": "#D55E00",
    "held": "#999933", "model-based": "#44AA99", "dyna": "#332288",
    "offset-free": "#AA4499", "identified": "#117733", "policy-search": "#661100",
    "backoff": "#6699CC", "pi": "#B08D57", "lqr": "#8C8CD9", "learnt": "#56B4E9",
}  # fmt: skip
_OTHERS = ("#CC6677", "#A6761D", "#E377C2", "#6D9E1F", "#B04FD0", "#4477AA", "#DDCC77")
_DASHES: Any = ((4, 1.5), (1, 1.2), (5, 1.5, 1, 1.5), (9, 2), (1, 3), (4, 1, 1, 1, 1, 1))
_LINES: Any = ("-", *((0, dashes) for dashes in _DASHES))
_STYLE = Path(__file__).with_name("house.mplstyle")


class Picture(Figure):
    """A figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        content = io.BytesIO()
        self.savefig(content, format="png", dpi=100)
        return content.getvalue()


@contextmanager
def figure(height: float, width: float = WIDTH) -> Iterator[Figure]:
    """A figure of the house style, in inches, without touching the user's own settings."""
    with mpl.rc_context(fname=_STYLE):
        yield Picture(figsize=(width, height), layout="constrained")


def save(drawn: Figure, path: str | Path) -> Path:
    """Write a figure as PNG (200 dpi) or SVG, by the path's suffix; same figure, same bytes.

    Raises FigureError on another suffix, OSError where the file cannot be written.
    """
    kind = Path(path).suffix.removeprefix(".")
    if kind not in ("png", "svg"):
        raise FigureError(f"cannot draw '{path}': the file must end in .png or .svg")
    content = io.BytesIO()
    FigureCanvasAgg(drawn)
    with mpl.rc_context(fname=_STYLE):
        # The SVG writer adds the date unless told not to.
        metadata = {"Date": None} if kind == "svg" else {"Software": "rti-cosim"}
        drawn.savefig(content, format=kind, dpi=200, metadata=metadata)
    return write_atomically(path, content.getvalue())


def save_set(figures: Iterable[tuple[str, Figure]], folder: Path) -> list[str]:
    """Write named figures into a folder, each as SVG and as PNG; returns the names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for name, drawn in figures:
        names.append(name)
        for suffix in ("svg", "png"):
            save(drawn, folder / f"{name}.{suffix}")
    return names


class Look(NamedTuple):
    """Colour and line style of a case, the same in every figure of a set."""

    color: str
    line: Any


def palette(names: Sequence[str], scenarios: Iterable[str] = ()) -> dict[str, Look]:
    """A look for each controller or case, in the order given.

    Cases of one rule, `rule` and `rule(start=naive)`, share a colour and differ in their line
    style; so do `case-SCENARIO` of several `scenarios`. Known rules have colours of their own, the
    same in all sets.
    """
    head_of = {name: name.partition("(")[0] for name in names}
    for name, scenario in product(names, scenarios):
        head_of[name] = head_of[name].removesuffix(f"-{scenario}")
    for name, head in head_of.items():
        rules = [known for known in _KNOWN if f"{head}-".startswith(f"{known}-")]
        head_of[name] = max(rules, key=len, default=head)
    heads = dict.fromkeys(head_of.values())
    others = cycle(_OTHERS)
    color = {head: _KNOWN.get(head) or next(others) for head in heads}
    used: dict[str, int] = {}
    looks = {}
    for name in names:
        own = color[head_of[name]]
        looks[name] = Look(own, _LINES[used.get(own, 0) % len(_LINES)])
        used[own] = used.get(own, 0) + 1
    return looks


def lit(color: str) -> str:
    """A colour, lightened where a dark ground would hide it."""
    rgb = to_rgb(color)
    if max(rgb) > 0.55:
        return color
    hue, lightness, saturation = rgb_to_hls(*rgb)
    return to_hex(hls_to_rgb(hue, max(lightness, 0.85 - lightness), saturation))


def plain(text: str) -> str:
    """The user's text, kept from being read as mathematics."""
    return text.replace("$", r"\$")


def shown_case(name: str) -> str:
    """A case's name as figures set it: `q-learning, naive` for `q-learning(start=naive)`."""
    head, _, settings = name.removesuffix(")").partition("(")
    if settings and "=" not in settings:  # a controller
        return plain(name)
    values = (word.removeprefix("start=").replace("=", " ") for word in settings.split())
    return plain(", ".join((head, *values)).replace("_", " "))


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
    text = f"${head}_{{{digits}}}$" if digits and head.isalpha() else plain(name.replace("_", " "))
    shown = plain({"degC": "°C", "1": ""}.get(unit, unit))
    return f"{text} [{shown}]" if shown else text


def regret_axis(
    axes: Axes, which: Literal["x", "y"], values: NDArray[np.float64], floor: float = FLOOR
) -> None:
    """Scale an axis for regrets in %: logarithmic above `floor`, linear below, J* at zero."""
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, floor)
    lowest = low / 1.6 if low > floor else min(1.6 * low, -0.3 * floor)
    getattr(axes, f"set_{which}scale")("symlog", linthresh=floor, linscale=0.5)
    getattr(axes, f"set_{which}lim")(lowest, 1.6 * max(high, floor))
    (axes.xaxis if which == "x" else axes.yaxis).set_major_formatter(FormatStrFormatter("%g"))


class Dots(NamedTuple):
    """Values of a case (K,), whether each finished, and a middle with its interval."""

    case: str
    values: NDArray[np.float64]
    finished: NDArray[np.bool_]
    middle: float
    low: float = np.nan
    high: float = np.nan


def dot_rows(axes: Axes, rows: Sequence[Dots], looks: Mapping[str, Look]) -> NDArray[np.float64]:
    """A row for each case: its values, crosses where one diverged, and their middle; all values."""
    for row, dots in enumerate(rows):
        count = len(dots.values)
        y = row + (np.linspace(-0.18, 0.18, count) if count > 1 else np.zeros(1))
        for marker, chosen in (("o", dots.finished), ("x", ~dots.finished)):
            axes.scatter(
                dots.values[chosen], y[chosen], marker=marker, s=13, alpha=0.55, zorder=3,
                color=looks[dots.case].color, linewidths=0 if marker == "o" else 0.9,
            )  # fmt: skip
        if np.isfinite([dots.low, dots.high]).all():
            axes.hlines(row, dots.low, dots.high, color=INK, linewidth=1.1, zorder=4)
        # A single value lies under its middle, which then has its case's colour.
        color = INK if count > 1 else looks[dots.case].color
        axes.vlines(dots.middle, row - 0.3, row + 0.3, color=color, linewidth=1.4, zorder=5)
    axes.set_yticks(range(len(rows)), [shown_case(dots.case) for dots in rows])
    axes.set_ylim(len(rows) - 0.4, -0.6)
    axes.grid(axis="y", visible=False)
    return np.concatenate([dots.values for dots in rows])


class EndLabel(NamedTuple):
    """A line's name as it is to be set, the ordinate at its end (data), and its colour."""

    text: str
    y: float
    color: str


def cost_lines(
    axes: Axes,
    lines: Iterable[tuple[str, NDArray[np.float64], NDArray[np.float64], Mapping[str, Any]]],
    levels: Mapping[str, float],
    *,
    relative: bool,
) -> list[EndLabel]:
    """Draw costs over samples, and levels as dashed lines; their names for `label_ends`.

    A line is (name, samples (K,), costs (K,), style); `relative` costs are regrets in %.
    """
    labels = [EndLabel(shown_case(name), level, REFERENCE) for name, level in levels.items()]
    for name, samples, costs, style in lines:
        axes.plot(samples, costs, **style)
        labels.append(EndLabel(shown_case(name), float(costs[-1]), style["color"]))
    for level in levels.values():
        axes.axhline(level, color=REFERENCE, linewidth=0.8, linestyle=DASHED)
    if relative:
        regret_axis(axes, "y", np.array(axes.dataLim.intervaly))
    return labels


def samples_axis(axes: Axes, end: float, text: str = "") -> None:
    """Let an abscissa show samples from 0 to `end`."""
    axes.set_xlim(0.0, end)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel(text)


def label_ends(drawn: Figure, labels: Iterable[tuple[Axes, Sequence[EndLabel]]]) -> None:
    """Write names right of each axes at their lines' ends, pushed apart where they overlap.

    The limits and the scale of the ordinate must be set before.
    """
    drawn.draw_without_rendering()
    for axes, own in labels:
        height = axes.get_window_extent().height * 72 / axes.figure.dpi
        low, high = (axes.transData.transform((0, y))[1] for y in axes.get_ylim())
        ends = np.array([axes.transData.transform((0, item.y))[1] for item in own])
        wanted = np.clip((ends - low) / (high - low), 0.0, 1.0)
        order = np.argsort(-wanted, kind="stable")
        placed = spread(wanted[order], 1.25 * END_SIZE / height) if own else ()
        for position, index in zip(placed, order, strict=True):
            item = own[index]
            arrow: Any = {
                "arrowstyle": "-", "color": item.color, "linewidth": 0.5, "shrinkB": 0.0,
                "shrinkA": 0.5, "relpos": (0.0, 0.5),
            }  # fmt: skip
            axes.annotate(
                item.text, xy=(1.0, float(wanted[index])), xytext=(1.035, position),
                xycoords="axes fraction", textcoords="axes fraction", fontsize=END_SIZE,
                color=item.color, va="center", ha="left", annotation_clip=False, arrowprops=arrow,
            )  # fmt: skip


def spread(positions: NDArray[np.float64], gap: float) -> NDArray[np.float64]:
    """Descending positions (K,) in [0, 1], moved as little as need be to be `gap` apart.

    They minimise the sum of the squared moves, within [0, 1]: an isotonic regression of
    `positions[i] + i·gap`, clipped. Where K gaps do not fit, the lowest is at 0.
    """
    from scipy.optimize import isotonic_regression  # noqa: PLC0415 - a third of a second

    steps = gap * np.arange(len(positions))
    placed: NDArray[np.float64] = isotonic_regression(positions + steps, increasing=False).x
    return np.clip(placed, steps[-1], max(1.0, steps[-1])) - steps
