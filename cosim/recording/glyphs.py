"""Text that the viewer can draw."""

_DRAWABLE = ((0x20, 0x24F), (0x370, 0x4FF), (0x2010, 0x2026))


def drawable(text: str) -> str:
    """Replace by `?` each character that the viewer's font lacks.

    The headless viewer aborts on such a character, and names and units are the user's to choose.
    """
    return "".join(
        c if c == "\n" or any(low <= ord(c) <= high for low, high in _DRAWABLE) else "?"
        for c in text
    )
