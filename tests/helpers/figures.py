"""What a reader of a figure sees of its letters: the boxes of all texts on the page."""

from itertools import combinations

from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text

TOUCH = 0.5
"""Pixels at 100 dpi by which two boxes may overlap: of letters, none reaches its box's edge."""


def boxes(figure):
    """Text and box in pixels of every text that is drawn, the layout done."""
    FigureCanvasAgg(figure).draw()
    hidden = set()
    for axis in figure.findobj(Axis):
        drawn = {id(tick) for tick in axis._update_ticks()}
        for tick in [*axis.get_major_ticks(), *axis.get_minor_ticks()]:
            if id(tick) not in drawn or not axis.axes.get_visible():
                hidden.update({id(tick.label1), id(tick.label2)})
    shown = []
    for text in figure.findobj(Text):
        is_shown = text.get_visible() and text.get_text().strip() and id(text) not in hidden
        if is_shown:
            shown.append((text.get_text(), Text.get_window_extent(text)))
    return shown


def overlaps(figure):
    """Pairs of texts of which one lies on the other."""
    pairs = []
    for (one, box), (other, other_box) in combinations(boxes(figure), 2):
        width = min(box.x1, other_box.x1) - max(box.x0, other_box.x0)
        height = min(box.y1, other_box.y1) - max(box.y0, other_box.y0)
        if min(width, height) > TOUCH:
            pairs.append((one, other))
    return pairs


def outside(figure):
    """Texts that the page cuts."""
    page = figure.bbox
    cut = []
    for text, box in boxes(figure):
        reach = max(page.x0 - box.x0, box.x1 - page.x1, page.y0 - box.y0, box.y1 - page.y1)
        if reach > TOUCH:
            cut.append(text)
    return cut
