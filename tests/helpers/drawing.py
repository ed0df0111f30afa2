"""Whether recordings can be drawn on this machine."""

import sys
from ctypes.util import find_library
from pathlib import Path

import pytest

FOLDERS = [Path(top, "vulkan", "icd.d") for top in ("/usr/share", "/usr/local/share", "/etc")]


def has_driver():
    """Whether a Vulkan driver and its loader are installed."""
    installed = any(folder.glob("*.json") for folder in FOLDERS)
    return sys.platform != "linux" or (installed and find_library("vulkan") is not None)


def skip_without_driver(message):
    """Skip a test whose drawing was refused for want of a driver, where there is none indeed."""
    if "no graphics driver" in message and not has_driver():
        pytest.skip("no graphics driver")
