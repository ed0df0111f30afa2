import threading
from contextlib import contextmanager, suppress
from time import sleep
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from matplotlib.image import imread

from cosim.core.errors import RecordingError
from cosim.recording import open_viewer, render, viewer
from tests.cosim.recording.test_recording import recorded
from tests.helpers.blocks import random_block
from tests.helpers.drawing import skip_without_driver

slow = pytest.mark.slow


@pytest.fixture
def recording(tmp_path, paper, rng, units):
    path = tmp_path / "run.rrd"
    recorded(path, paper, [random_block(paper, rng, 0, 50)], units, 50)
    return path


def drawn(recording, png, **options):
    """Render, or skip where no graphics driver is installed."""
    try:
        render(recording, png, **options)
    except RecordingError as error:
        skip_without_driver(str(error))
        raise
    return imread(png)


@slow
def test_a_recording_is_drawn_without_a_screen(recording, tmp_path):
    image = drawn(recording, tmp_path / "a.png", at=600.0, size=(1280, 720))
    assert image.shape[:2] == (720, 1280)
    assert len(np.unique((image[..., :3] * 255).astype(int).reshape(-1, 3), axis=0)) > 200


@slow
def test_the_viewer_listens_on_loopback_only_and_ends(recording, tmp_path):
    seen = set()
    stop = threading.Event()

    def watch():
        while not stop.is_set():
            with suppress(psutil.Error):
                found = [c for viewer in viewers() for c in viewer.net_connections("inet")]
                seen.update(c.laddr.ip for c in found if c.status == psutil.CONN_LISTEN)
            sleep(0.05)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        drawn(recording, tmp_path / "a.png")
    finally:
        stop.set()
        watcher.join()
    assert seen == {"127.0.0.1"}
    assert not viewers()


def viewers():
    """Viewers without a window that this test has started."""
    children = psutil.Process().children(recursive=True)
    return [child for child in children if child.name() == "rerun"]


@slow
def test_without_a_graphics_driver_there_is_no_picture(recording, tmp_path, monkeypatch):
    for variable in ("VK_ICD_FILENAMES", "VK_DRIVER_FILES"):
        monkeypatch.setenv(variable, "/nonexistent")
    with pytest.raises(RecordingError, match="mesa-vulkan-drivers"):
        render(recording, tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()


@contextmanager
def no_process(command, **_):
    """In place of a viewer that is started."""
    yield SimpleNamespace(wait=lambda: 0, command=command)


def test_the_window_binds_loopback_and_calls_nobody(recording, monkeypatch):
    started = []
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(
        viewer, "child_process", lambda *a, **k: started.append((*a, *k.values())) or no_process(*a)
    )
    open_viewer(recording)
    ((command, environment),) = started
    assert command[command.index("--bind") + 1] == "127.0.0.1"
    assert command[-1] == str(recording)
    assert environment["CI"] == "true"
    assert environment["https_proxy"] == environment["HTTP_PROXY"] == "http://127.0.0.1:9"
