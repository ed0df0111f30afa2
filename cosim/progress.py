"""Progress bars on a terminal and in a notebook, by tqdm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock


@contextmanager
def progress_bar(label: str, total: int) -> Iterator[Callable[..., None]]:
    """Draw a bar of samples; yields a function of the number done and of a remark behind it."""
    from tqdm.auto import tqdm  # noqa: PLC0415, only where a bar is drawn

    # No thread that watches the bar, and no lock between processes: one process draws it.
    tqdm.monitor_interval = 0
    tqdm.set_lock(RLock())
    looks = {"unit": " samples", "unit_scale": True, "miniters": 1, "dynamic_ncols": True}
    with tqdm(total=total, desc=label, **looks) as bar:

        def update(done: int, remark: str = "") -> None:
            bar.set_postfix_str(remark, refresh=False)
            bar.update(done - bar.n)

        yield update


@contextmanager
def told(
    progress: Callable[..., None] | bool | None,
    label: str,
    total: int,
    read: Callable[..., tuple[int, str]] = lambda done, remark="": (done, remark),
) -> Iterator[Callable[..., None]]:
    """Yield the function that an argument `progress` stands for.

    A function is itself. True draws a bar; `read` turns what the function is called with into the
    number done and a remark. False and None do nothing.
    """
    if callable(progress):
        yield progress
    elif progress:
        with progress_bar(label, total) as update:
            yield lambda *news: update(*read(*news))
    else:
        yield lambda *news: None
