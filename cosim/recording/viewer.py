"""Shows a recording: in the viewer's window, or as a PNG on a machine without a screen."""

from __future__ import annotations

import os
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from math import isfinite
from pathlib import Path

from rerun.experimental import ViewerClient

from cosim.core.errors import RecordingError
from cosim.core.files import replacing
from cosim.core.processes import child_process
from cosim.recording.read import SAMPLE, TIMELINE, existing, worst_moment

LOOPBACK = "127.0.0.1"
# The port "discard", at which nothing listens.
_NOWHERE = f"http://{LOOPBACK}:9"
_PROXIES = ("http_proxy", "https_proxy", "all_proxy")
_NO_DRIVER = ("No graphics adapter", "Failed to get render context")


def open_viewer(path: str | Path) -> None:
    """Open a recording in a window and wait until it is closed; the viewer binds 127.0.0.1 only.

    Raises RecordingError where there is no such file, no display or no graphics driver.
    """
    command = [*_viewer(), "--port", "auto", str(existing(path))]
    has_display = "DISPLAY" in os.environ or "WAYLAND_DISPLAY" in os.environ
    # The systems with one desktop always have a display.
    if sys.platform == "linux" and not has_display:
        raise RecordingError(f"no display to show {path} on; draw it with --png FILE instead")
    with child_process(command, env=_silent("warn")) as viewer:
        code = viewer.wait()
    # 130: whoever looks at it ended it by Ctrl-C.
    if code not in (0, 130):
        raise RecordingError(f"the viewer could not show {path}; its messages are above")


def render(
    path: str | Path,
    png: str | Path,
    *,
    at: float | None = None,
    size: tuple[int, int] = (1920, 1080),
    timeout: float = 60.0,
) -> None:
    """Draw a recording to a PNG without a screen.

    Args:
        path: of the recording.
        png: path of the picture.
        at: where the time cursor stands, in s of the run, or a sample's number where there is no
            time (a training); by default at the worst violation of a run, or its end.
        size: width and height in pixels.
        timeout: in s.

    Raises:
        RecordingError: if there is no such file or graphics driver, a view failed or the time was
            not enough.
        OSError: if the PNG cannot be written.
    """
    if at is not None and not isfinite(at):
        raise RecordingError(f"the time of the cursor (--at) must be finite, not {at}")
    path = existing(path)
    if at is None:
        at = worst_moment(path)
    deadline = time.monotonic() + timeout
    with replacing(png) as target:
        target.write_bytes(_drawn(path, at, size, deadline))


def _drawn(
    path: Path,
    at: float | None,
    size: tuple[int, int],
    deadline: float,
) -> bytes:
    """The picture of a recording as the bytes of a PNG; arguments as of `render`."""
    try:
        with _headless(size, deadline) as client:
            client.open(str(path.resolve()))
            _wait(lambda: not client.get_state().loading, deadline, f"loading {path}")
            recordings = client.get_state().recordings
            if not recordings:
                raise RecordingError(f"{path} holds no recording")
            timelines = set()
            for recording in recordings:
                for timeline in recording.timelines:
                    timelines.add(timeline.name)
            if at is not None and TIMELINE in timelines:
                client.set_time(TIMELINE, duration=at, play_state="paused")
            elif at is not None:
                client.set_time(SAMPLE, sequence=round(at), play_state="paused")
            picture = client.take_screenshot()

            def is_unchanged() -> bool:
                nonlocal picture
                previous = picture
                picture = client.take_screenshot()
                return picture == previous

            # Chunks are fetched after loading has ended: two pictures in a row must be equal.
            _wait(is_unchanged, deadline, "drawing")
            # The viewer writes a view's errors into the picture, and exits with 0.
            for view in client.get_state().views:
                for report in view.reports:
                    raise RecordingError(f"view '{view.name}' of {path}: {report.summary}")
    except TimeoutError as error:
        raise RecordingError(
            "the viewer did not answer in time; the machine may be busy: try again"
        ) from error
    return picture


def _viewer() -> list[str]:
    """The viewer's own program: `python -m rerun` would start it as a grandchild."""
    command = find_spec("rerun_cli")
    if command is None or command.origin is None:
        raise RecordingError("the viewer is not installed: pip install 'rti-cosim[view]'")
    folder = Path(command.origin).parent
    program = folder / ("rerun.exe" if os.name == "nt" else "rerun")
    # On macOS it is an application.
    bundled = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"
    if bundled.exists():
        program = bundled
    return [str(program), "--bind", LOOPBACK]


def _silent(level: str) -> dict[str, str]:
    """Environment in which the viewer opens no connection and prints messages from a level on."""
    # Its usage statistics are off in continuous integration; its look for a newer version has no
    # switch, but goes through a proxy, and nothing listens at this one.
    environment = dict(os.environ)
    environment.pop("FORCE_RERUN_ANALYTICS", None)
    environment["CI"] = "true"
    # Programs read these names in small letters, in capitals, or in both.
    for name in _PROXIES:
        environment[name] = _NOWHERE
        environment[name.upper()] = _NOWHERE
    environment["no_proxy"] = LOOPBACK
    environment["NO_PROXY"] = LOOPBACK
    environment["RUST_LOG"] = level
    return environment


@contextmanager
def _headless(size: tuple[int, int], deadline: float) -> Iterator[ViewerClient]:
    """A viewer process without a window, ended on exit."""
    # The system gives a port that is free; the viewer does not tell one that it chose itself.
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = int(probe.getsockname()[1])
    width, height = size
    command = [*_viewer(), "--headless", "--hide-welcome-screen", "--port", str(port)]
    command += ["--window-size", f"{width}x{height}"]
    # Messages below an error would be drawn over the views.
    with (
        tempfile.TemporaryFile() as log,
        child_process(command, log=log, env=_silent("error")) as process,
    ):

        def answers() -> bool:
            if process.poll() is not None:
                raise RecordingError(_viewer_complaint(log.fileno()))
            with socket.socket() as probe:
                return probe.connect_ex((LOOPBACK, port)) == 0

        _wait(answers, deadline, "starting the viewer")
        try:
            yield ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")
        except (ConnectionError, RuntimeError) as error:
            raise RecordingError(_viewer_complaint(log.fileno())) from error


def _wait(done: Callable[[], bool], deadline: float, task: str) -> None:
    """Wait until something is done; raises RecordingError after a deadline of the clock."""
    while not done():
        if time.monotonic() > deadline:
            raise RecordingError(f"{task} took too long")
        time.sleep(0.1)


def _viewer_complaint(log: int) -> str:
    """The reason of the viewer's end, from its log."""
    text = os.pread(log, 1 << 20, 0).decode(errors="replace")
    if any(sign in text for sign in _NO_DRIVER):
        return (
            "no graphics driver for drawing without a screen; install a software one, on Debian: "
            "apt-get install libvulkan1 mesa-vulkan-drivers"
        )
    reason = "the viewer ended without a message"
    for line in text.splitlines():
        if "panicked" in line or "rror" in line:
            reason = line.strip()
    return reason
