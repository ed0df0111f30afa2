"""The look of every figure: colours, axes, names at the ends of lines, and byte-stable files."""

from __future__ import annotations

import io
import textwrap
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from colorsys import hls_to_rgb, rgb_to_hls
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from typing import Any, Literal, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, FixedLocator, FormatStrFormatter
from matplotlib.transforms import ScaledTranslation
from numpy.typing import NDArray

from cosim.core.errors import FigureError
from cosim.core.files import write_atomically
from cosim.core.protocols import Array

WIDTH = 7.16
"""Width of a two-column figure in inches, as journals print it."""
COLUMN = 3.5
"""Width of a one-column figure in inches."""
SCREEN = 4.6
"""Width in inches of a page's figure: its letters can be read on a screen of 400 pixels."""
NARROW = 5.5
"""Width in inches below which panels stand below each other."""
FORMATS = ("svg", "png")
"""Formats of the figures of a study."""
FLOOR = 0.01
"""Regret in % below which an axis is linear."""

# The end of the map is too bright for a line on white.
_SHARES = np.linspace(0.0, 0.88, 6)
ENTRIES = tuple(to_hex(color) for color in mpl.colormaps["viridis"](_SHARES))
"""Colours of θ's blocks and entries, none of which is a controller's."""
BOUND = "#B2182B"
REFERENCE = "#5A6570"
INK = "#222222"
END_SIZE = 6.5
TITLE_SIZE = 9.0
DETAIL_SIZE = 7.0
"""Sizes in points of the names at lines' ends, of a figure's question, of what stands below it."""
LINE_SPACING = 1.45
"""Least distance of two names at lines' ends, in units of their size: less, and they touch."""
NAME_CHARACTERS = 28
"""Characters of a line of such a name, where there is room for several lines."""
KEY = 7.0
"""Width in points of the marker before a name at a line's end."""
DASHED: Any = (0, (4, 2))
_KNOWN = {
    "naive": "#7F7F7F",
    "tuned": "#E69F00",
    "converged": "#CC79A7",
    "optimal": "#111111",
    "q-learning": "#0072B2",
    "batch-q-learning": "#009E73",
    "actor-critic": "#D55E00",
    "fixed": "#999933",
    "model-based": "#44AA99",
    "dyna": "#332288",
    "offset-free": "#AA4499",
    "identified": "#117733",
    "policy-search": "#661100",
    "backoff": "#6699CC",
    "pi": "#B08D57",
    "lqr": "#8C8CD9",
    "learned": "#56B4E9",
    "backed-off": "#C9A227",
    "cautious": "#882255",
}
"""Colours of the rules and controllers that every figure knows."""
_OTHERS = ("#CC6677", "#A6761D", "#E377C2", "#6D9E1F", "#B04FD0", "#4477AA", "#DDCC77")
# Lengths of strokes and gaps in turn, as matplotlib takes them: offset and pattern.
_LINES: Any = [
    "-",
    (0, (4, 1.5)),
    (0, (1, 1.2)),
    (0, (5, 1.5, 1, 1.5)),
    (0, (9, 2)),
    (0, (1, 3)),
    (0, (4, 1, 1, 1, 1, 1)),
]
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
# Of an axis of regrets: decades that are shown, up to which these multiples of each have a tick.
_TICKS = ((1.3, (1, 2, 5)), (2.6, (1, 3)), (np.inf, (1,)))
_STYLE = Path(__file__).with_name("house.mplstyle")


class StyledFigure(Figure):
    """A figure that a notebook shows without pyplot."""

    def _repr_png_(self) -> bytes:
        content = io.BytesIO()
        self.savefig(content, format="png", dpi=100)
        return content.getvalue()


@contextmanager
def figure(height: float, width: float = WIDTH) -> Iterator[Figure]:
    """A figure of the house style, without touching the user's own settings.

    Args:
        height: in inches.
        width: in inches.
    """
    with mpl.rc_context(fname=_STYLE):
        yield StyledFigure(figsize=(width, height), layout="constrained")


def ask(drawn: Figure, question: str, detail: str = "") -> None:
    """Write the question that a figure answers above it, and what one must know below it.

    Args:
        drawn: the figure.
        question: a sentence that ends in a question mark.
        detail: what was drawn, and what its marks mean.
    """
    points = 72 * drawn.get_figwidth()
    # A letter is about six tenths as wide as it is high, and a bold one two thirds.
    title = textwrap.fill(question, int(points / (0.67 * TITLE_SIZE)), break_long_words=False)
    drawn.suptitle(title, x=0.01, ha="left", fontsize=TITLE_SIZE, fontweight="bold")
    if detail:
        text = textwrap.fill(detail, int(points / (0.58 * DETAIL_SIZE)), break_long_words=False)
        drawn.supxlabel(text, x=0.01, ha="left", fontsize=DETAIL_SIZE, color=REFERENCE)


def save(drawn: Figure, path: str | Path) -> Path:
    """Write a figure as PNG (200 dpi) or SVG; the same figure gives the same bytes.

    Args:
        drawn: the figure.
        path: of the file; its suffix says the format.

    Returns:
        The path.

    Raises:
        FigureError: on another suffix.
        OSError: if the file cannot be written.
    """
    kind = Path(path).suffix.removeprefix(".")
    if kind not in ("png", "svg"):
        raise FigureError(f"cannot draw '{path}': the file must end in .png or .svg")
    content = io.BytesIO()
    # Not the user's backend, which may need a screen.
    FigureCanvasAgg(drawn)
    with mpl.rc_context(fname=_STYLE):
        metadata: dict[str, str | None] = {"Software": "rti-cosim"}
        if kind == "svg":
            # The SVG writer adds the date unless told not to, and knows no software.
            metadata = {"Date": None}
        drawn.savefig(content, format=kind, dpi=200, metadata=metadata)
    return write_atomically(path, content.getvalue())


def save_set(
    figures: Iterable[tuple[str, Figure]],
    folder: Path,
    formats: Sequence[str] = FORMATS,
) -> list[str]:
    """Write named figures into a folder.

    Args:
        figures: pairs of a name, which is the file's without suffix, and its figure.
        folder: where they are written; made if it is not there.
        formats: file suffixes without the dot, `svg` or `png`; a file of each is written.

    Returns:
        The names, in the order given.
    """
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for name, drawn in figures:
        names.append(name)
        for suffix in formats:
            save(drawn, folder / f"{name}.{suffix}")
    return names


class LineStyle(NamedTuple):
    """Colour, line style and marker of a case, the same in every figure of a set."""

    color: str
    line: Any
    marker: str = ""
    """Empty where no other case has the colour."""


def palette(
    names: Sequence[str],
    scenarios: Iterable[str] = (),
) -> dict[str, LineStyle]:
    """A line style for each controller or case.

    Cases of one rule, `rule` and `rule(start=naive)`, share a colour and differ in their line and
    marker; so do `case-SCENARIO` of several scenarios. Known rules have colours of their own, the
    same in all sets.

    Args:
        names: of the cases, in the order of the figures.
        scenarios: names that a case's may end in.
    """
    endings = [f"-{scenario}" for scenario in scenarios]
    rules = {name: _rule(name, endings) for name in names}
    # Rules that are not known have the other colours, in the order in which they come.
    other_colors = cycle(_OTHERS)
    colors: dict[str, str] = {}
    for rule in rules.values():
        if rule in _KNOWN:
            colors[rule] = _KNOWN[rule]
        elif rule not in colors:
            colors[rule] = next(other_colors)
    # Counted by colour, not by rule: two rules may have one colour.
    n_cases = Counter(colors[rule] for rule in rules.values())
    n_lines: Counter[str] = Counter()
    styles = {}
    for name, rule in rules.items():
        color = colors[rule]
        number = n_lines[color] % len(_LINES)
        # Dashes alone cannot be told apart where lines lie close.
        marker = _MARKERS[number] if n_cases[color] > 1 else ""
        styles[name] = LineStyle(color, _LINES[number], marker)
        n_lines[color] += 1
    return styles


def _rule(name: str, endings: Sequence[str]) -> str:
    """The rule that a case's name begins with: a known one's name, or all but its settings."""
    head = name.partition("(")[0]
    for ending in endings:
        head = head.removesuffix(ending)
    # `fixed-late` is of `fixed`, and `fixedpoint` is not; of several rules the longest one fits.
    known = [rule for rule in _KNOWN if f"{head}-".startswith(f"{rule}-")]
    return max(known, key=len, default=head)


def lighten(color: str) -> str:
    """A colour, lightened where a dark ground would hide it."""
    rgb = to_rgb(color)
    # Bright enough on a dark ground.
    if max(rgb) > 0.55:
        return color
    hue, lightness, saturation = rgb_to_hls(*rgb)
    # The hue stays: it is what tells the rules apart in all figures.
    lighter = max(lightness, 0.85 - lightness)
    lighter_rgb = hls_to_rgb(hue, lighter, saturation)
    return to_hex(lighter_rgb)


def plain(text: str) -> str:
    """The user's text, kept from being read as mathematics."""
    return text.replace("$", r"\$")


def shown_case(name: str) -> str:
    """A case's name as figures set it: `q-learning, naive` for `q-learning(start=naive)`."""
    rule, _, settings = name.removesuffix(")").partition("(")
    # A controller of a list, `name(controller)`, has no settings.
    if settings and "=" not in settings:
        return plain(name)
    parts = [rule]
    for setting in settings.split():
        # Where θ starts is told by its name alone.
        text = setting.removeprefix("start=")
        parts.append(text.replace("=", " "))
    shown_name = ", ".join(parts)
    return plain(shown_name.replace("_", " "))


def symbol(name: str) -> str:
    """`B_Vf` as mathematics, B with the block's subscript."""
    head, _, subscript = name.partition("_")
    if not head.isalpha() or "$" in name:
        return plain(name)
    if not subscript:
        return f"${head}$"
    symbols = {"lambda": r"\lambda", "sigma": r"\sigma", "Vf": r"V^\mathrm{f}"}
    # The stage cost's blocks are set with ℓ; x_l is the lower bound.
    if head in ("B", "b"):
        symbols["l"] = r"\ell"
    text = symbols.get(subscript, subscript)
    return f"${head}_{{{text}}}$"


def label(name: str, unit: str) -> str:
    """Axis label `name [unit]`; `X2` prints with its digits as a subscript.

    Args:
        name: of the signal.
        unit: as FMI writes it; `1` and nothing are not shown.
    """
    head = name.rstrip("0123456789")
    digits = name[len(head) :]
    text = plain(name.replace("_", " "))
    if digits and head.isalpha():
        text = f"${head}_{{{digits}}}$"
    if unit in ("", "1"):
        return text
    shown_unit = "°C" if unit == "degC" else plain(unit)
    return f"{text} [{shown_unit}]"


def regret_axis(
    axes: Axes,
    which: Literal["x", "y"],
    values: Array,
    floor: float = FLOOR,
) -> None:
    """Scale an axis for regrets: logarithmic above a floor, linear below, J* at zero.

    The outermost ticks lie beyond the values, so that each can be read off.

    Args:
        axes: what is scaled.
        which: its axis.
        values: the regrets that it must show, in %, of any shape; not finite ones do not count.
        floor: in %.
    """
    finite = values[np.isfinite(values)]
    low = 0.0
    high = floor
    # All runs may have diverged.
    if finite.size:
        low = float(finite.min())
        high = float(finite.max())
    ticks = _regret_ticks(low, high, floor)
    # A margin that is a factor; on the linear part, where J* is, a share of it.
    first = min(1.6 * low, -0.3 * floor, 1.05 * ticks[0])
    if low > floor:
        first = min(low / 1.6, ticks[0] / 1.05)
    last = max(1.6 * max(high, floor), 1.05 * ticks[-1])
    # matplotlib has no setter for an axis by its letter.
    if which == "x":
        axes.set_xscale("symlog", linthresh=floor, linscale=0.5)
        axes.set_xlim(first, last)
        axis: Axis = axes.xaxis
    else:
        axes.set_yscale("symlog", linthresh=floor, linscale=0.5)
        axes.set_ylim(first, last)
        axis = axes.yaxis
    axis.set_major_locator(FixedLocator(ticks))
    axis.set_major_formatter(FormatStrFormatter("%g"))


def _regret_ticks(low: float, high: float, floor: float) -> list[float]:
    """Ticks of an axis of regrets, in %, increasing, the first and the last beyond the values.

    Args:
        low: least value.
        high: largest value.
        floor: above it the axis is logarithmic.
    """
    least = max(low, floor)
    decades = np.log10(max(high, floor) / least)
    multiples = next(multiples for most, multiples in _TICKS if decades <= most)
    if low > floor:
        # Beyond the largest value, so that equal ones lie between two ticks.
        ticks = _ladder(least, 1.01 * high, multiples)
        n_below = sum(tick <= low for tick in ticks)
        return ticks[n_below - 1 :]
    ticks = [0.0, *_ladder(floor, high, multiples)]
    # A value that is a rounding error below 0 has no tick of its own.
    if low > -0.1 * floor:
        return ticks
    # Finer at the end than above 0, where most of the axis is: a decade would be all but empty.
    lowest = _ladder(floor, -low, (1, 2, 5))[-1]
    ticks = [-lowest, *ticks]
    for tick in _ladder(floor, -low, (1,)):
        # One of half the outermost tick's size would be too close to it.
        if tick < 0.4 * lowest:
            ticks.insert(1, -tick)
    return ticks


def _ladder(start: float, end: float, multiples: Sequence[int]) -> list[float]:
    """Multiples of the decades from the one of `start` to the first that is `end` or more."""
    ticks: list[float] = []
    exponent = int(np.floor(np.log10(start)))
    while not ticks or ticks[-1] < end:
        for multiple in multiples:
            # Written, since a power of ten that is computed has a rounding error.
            tick = float(f"{multiple}e{exponent}")
            if not ticks or ticks[-1] < end:
                ticks.append(tick)
        exponent += 1
    return ticks


class DotRow(NamedTuple):
    """Values of a case (K,), whether each finished, and a middle with its interval."""

    case: str
    values: Array
    finished: NDArray[np.bool_]
    middle: float
    low: float = np.nan
    high: float = np.nan


def dot_rows(axes: Axes, rows: Sequence[DotRow], styles: Mapping[str, LineStyle]) -> Array:
    """Draw a row for each case: its values, crosses where one diverged, their middle, its interval.

    Args:
        axes: where they are drawn.
        rows: the cases, from above.
        styles: line style of each case by its name.

    Returns:
        The values of all rows, one after the other.
    """
    names = []
    for position, row in enumerate(rows):
        _dot_row(axes, position, row, styles[row.case].color)
        names.append(shown_case(row.case))
    n_rows = len(rows)
    axes.set_yticks(range(n_rows), names)
    # The first row is above.
    axes.set_ylim(n_rows - 0.4, -0.6)
    # A grid line would lie on the dots of its row.
    axes.grid(axis="y", visible=False)
    return np.concatenate([row.values for row in rows])


def _dot_row(axes: Axes, position: int, row: DotRow, color: str) -> None:
    """Draw the row of a case at a position on the ordinate."""
    is_single = len(row.values) == 1
    # Values beside each other are drawn a little above each other.
    reach = 0.0 if is_single else 0.18
    y = position + np.linspace(-reach, reach, len(row.values))
    finished = row.finished
    marks = {"o": finished, "x": ~finished}
    for marker, is_marked in marks.items():
        axes.scatter(
            row.values[is_marked],
            y[is_marked],
            s=13,
            marker=marker,
            # A cross is all line, and a dot has no edge.
            linewidths=0.9 if marker == "x" else 0,
            color=color,
            alpha=0.55,
            zorder=3,
        )
    # An interval without an end is not drawn: nothing is known of it.
    if np.isfinite([row.low, row.high]).all():
        axes.hlines(position, row.low, row.high, color=INK, linewidth=1.1, zorder=4)
    axes.vlines(
        row.middle,
        position - 0.3,
        position + 0.3,
        # A single value lies under its middle, which then has its case's colour.
        color=color if is_single else INK,
        linewidth=1.4,
        zorder=5,
    )


class EndLabel(NamedTuple):
    """A line's name as it is to be set, the ordinate at its end (data), its colour and marker."""

    text: str
    y: float
    color: str
    marker: str = ""


class CostLine(NamedTuple):
    """Costs (K,) over samples (K,): name of the case, and arguments of `Axes.plot`."""

    name: str
    samples: Array
    costs: Array
    look: Mapping[str, Any]
    marker: str = ""
    """Stands before the name, where it tells the line from others of its colour."""


def cost_lines(
    axes: Axes,
    lines: Iterable[CostLine],
    levels: Mapping[str, float],
    *,
    relative: bool,
) -> list[EndLabel]:
    """Draw costs over samples, and levels as dashed lines.

    Args:
        axes: where they are drawn.
        lines: the costs; each look has a `color`.
        levels: costs to compare with, by name.
        relative: whether costs are regrets in %.

    Returns:
        The names, for `label_ends`: those of the levels, then those of the lines.
    """
    labels = []
    for name, level in levels.items():
        text = shown_case(name)
        labels.append(EndLabel(text, level, REFERENCE))
    for line in lines:
        axes.plot(line.samples, line.costs, **line.look)
        label_of_line = EndLabel(
            text=shown_case(line.name),
            y=float(line.costs[-1]),
            color=line.look["color"],
            marker=line.marker,
        )
        labels.append(label_of_line)
    for level in levels.values():
        axes.axhline(level, color=REFERENCE, linewidth=0.8, linestyle=DASHED)
    if relative:
        # What was drawn so far, the levels with it, is what the axis must show.
        drawn_range = np.array(axes.dataLim.intervaly)
        regret_axis(axes, "y", drawn_range)
    return labels


def samples_axis(axes: Axes, end: float, text: str = "") -> None:
    """Let an abscissa show samples from 0 on.

    Args:
        axes: what is scaled.
        end: the last sample.
        text: label of the axis.
    """
    axes.set_xlim(0.0, end)
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_xlabel(text)


def label_ends(drawn: Figure, labels: Iterable[tuple[Axes, Sequence[EndLabel]]]) -> None:
    """Write names right of axes at their lines' ends, pushed apart where they overlap.

    Args:
        drawn: the figure; limits and scales of the ordinates must be set before.
        labels: axes, each with its lines' names.
    """
    # Where a line ends on the page is known once the figure is laid out.
    drawn.draw_without_rendering()
    for axes, names in labels:
        if not names:
            continue
        heights = [_height(axes, name.y) for name in names]
        ends = np.clip(heights, 0.0, 1.0)
        highest_first = np.argsort(-ends, kind="stable")
        # A line of text, as a share of the axes' height.
        axes_pixels = axes.get_window_extent().height
        axes_points = axes_pixels * 72 / axes.figure.dpi
        gap = LINE_SPACING * END_SIZE / axes_points
        texts = [name.text for name in names]
        # Long names would leave a narrow panel no room.
        wrapped = [textwrap.fill(text, NAME_CHARACTERS) for text in texts]
        most_lines = 1 + max(text.count("\n") for text in wrapped)
        if most_lines * gap * len(names) <= 1.0:
            texts = wrapped
            gap *= most_lines
        positions = spread(ends[highest_first], gap)
        for position, index in zip(positions, highest_first, strict=True):
            name = names[index]._replace(text=texts[index])
            end = float(ends[index])
            _label_end(drawn, axes, name, end, float(position))


def _height(axes: Axes, y: float) -> float:
    """Position of an ordinate on the page, as a share of the axes' height."""
    low, high = axes.get_ylim()
    points = [(0, low), (0, high), (0, y)]
    # By way of the page, since the ordinate may be logarithmic.
    on_page = axes.transData.transform(points)
    bottom, top, here = on_page[:, 1]
    return float((here - bottom) / (top - bottom))


def _label_end(
    drawn: Figure,
    axes: Axes,
    name: EndLabel,
    end: float,
    position: float,
) -> None:
    """Write a name at a position, with a line to its line's end; both are shares of the height."""
    arrow: Any = {
        "arrowstyle": "-",
        "color": name.color,
        "linewidth": 0.5,
        "shrinkB": 0.0,
        "shrinkA": 0.5,
        "relpos": (0.0, 0.5),
    }
    # The marker of the line stands before its name, as in a legend.
    indent = KEY if name.marker else 0.0
    scale = drawn.dpi_scale_trans
    beside: Any = axes.transAxes + ScaledTranslation(indent / 72, 0.0, scale)
    if name.marker:
        key = Line2D(
            [1.035],
            [position],
            marker=name.marker,
            markersize=3.5,
            color=name.color,
            clip_on=False,
            transform=axes.transAxes + ScaledTranslation(0.4 * KEY / 72, 0.0, scale),
        )
        axes.add_artist(key)
    axes.annotate(
        name.text,
        xy=(1.0, end),
        xytext=(1.035, position),
        xycoords="axes fraction",
        textcoords=beside,
        fontsize=END_SIZE,
        color=name.color,
        va="center",
        ha="left",
        annotation_clip=False,
        arrowprops=arrow,
    )


def spread(positions: Array, gap: float) -> Array:
    """Move positions apart, as little as need be.

    The sum of the squared moves is least, within [0, 1]: an isotonic regression of
    `positions[i] + i·gap`, clipped. Where K gaps do not fit, the lowest is at 0.

    Args:
        positions: (K,) in [0, 1], descending.
        gap: least distance of two.

    Returns:
        The positions, (K,), at least `gap` apart.
    """
    from scipy.optimize import isotonic_regression  # noqa: PLC0415 - a third of a second

    # With the gaps added, "at least a gap apart" is "not increasing".
    gaps = gap * np.arange(len(positions))
    placed: Array = isotonic_regression(positions + gaps, increasing=False).x
    lowest = gaps[-1]
    highest = max(1.0, lowest)
    return np.clip(placed, lowest, highest) - gaps
