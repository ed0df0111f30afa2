"""Formulas as MathML, made when the site is built: a page needs no script and no network."""

from __future__ import annotations

import html
import re

from latex2mathml.converter import convert

INLINE = re.compile(r'<span class="arithmatex">\\\((.*?)\\\)</span>', re.DOTALL)
DISPLAY = re.compile(r'<div class="arithmatex">\s*\\\[(.*?)\\\]\s*</div>', re.DOTALL)
# LaTeX that the converter does not know or turns into what browsers ignore, and its equal.
UNKNOWN = re.compile(r"\{aligned\}")
UNBRACED = re.compile(r"\\(mathcal|mathbb)\s*([A-Z])")
LIMITS = re.compile(r"\\min_")


def _convert(formula: str, display: str) -> str:
    text = UNBRACED.sub(r"\\\1{\2}", UNKNOWN.sub("{split}", html.unescape(formula).strip()))
    if display == "block":
        text = LIMITS.sub(r"\\min\\limits_", text)
    return convert(text, display=display)


def on_page_content(content: str, **_: object) -> str:
    """Replace what `pymdownx.arithmatex` marked."""
    content = DISPLAY.sub(lambda m: _convert(m[1], "block"), content)
    return INLINE.sub(lambda m: _convert(m[1], "inline"), content)
