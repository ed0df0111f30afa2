"""Progress bars on a terminal and in a notebook, by tqdm."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import RLock


@contextmanager
def told(
    progress: Callable[..., None] | bool,
    label: str,
    total: int,
    read: Callable[..., tuple[int, str]] = lambda done, remark="", *_: (done, remark),
) -> Iterator[Callable[..., None]]:
    """Yield the callback of an argument `progress`: itself, a bar, or a no-op.

    True stands for a bar of `total` samples: `read` turns what the function is called with into
    the number done and a remark.
    """
    if callable(progress) or not progress:
        yield progress or (lambda *news: None)
        return
    from tqdm.auto import tqdm  # noqa: PLC0415, only where a bar is drawn

    # No thread that watches the bar, and no lock between processes: one process draws it.
    tqdm.monitor_interval = 0
    tqdm.set_lock(RLock())
    form = "{l_bar}{bar}| {n_fmt}/{total_fmt} [{remaining}{postfix}]"
    looks = {"bar_format": form, "unit_scale": True, "miniters": 1, "dynamic_ncols": True}
    with tqdm(total=total, desc=label, **looks) as bar:

        def update(*news: object) -> None:
            done, remark = read(*news)
            bar.set_postfix_str(remark, refresh=False)
            bar.update(done - bar.n)

        yield update
