"""Runs a command for as long as somebody holds the other end of standard input.

A program of its own, run by its path with nothing but the standard library, so that it starts in
some milliseconds: `python guardian.py FOLDER COMMAND ARGUMENT…`. The parent keeps the pipe open;
whatever ends the parent closes it, even a SIGKILL, and the command's whole process group ends then.
Its temporary files go to a folder that ends with it. It runs in FOLDER unless that is empty; then
its exit code is written to FOLDER/exit-code, and FOLDER deleted once the parent lets go.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path
from types import FrameType

EXIT_CODE = "exit-code"
PATIENCE = 2.0
"""Seconds that a process group has to end by itself."""


def end(child: "subprocess.Popen[bytes]") -> None:
    """End the child and what it started: politely, then at once."""
    if sys.platform == "win32":
        subprocess.run(
            ["taskkill", "/T", "/F", "/PID", str(child.pid)], check=False, capture_output=True
        )
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        try:
            os.killpg(child.pid, number)
        except ProcessLookupError:
            return
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            child.poll()
            try:
                os.killpg(child.pid, 0)
            except ProcessLookupError:
                return
            time.sleep(0.02)


def tell(folder: Path, code: int) -> None:
    """Leave the exit code in the folder, whole."""
    with suppress(OSError):
        (folder / ".exit-code").write_text(str(code))
        (folder / ".exit-code").replace(folder / EXIT_CODE)


def main() -> int:
    """Run the command of the arguments; its exit code, 128 + n where signal n ended it."""
    with tempfile.TemporaryDirectory(prefix="cosim-", ignore_cleanup_errors=True) as temporary:
        return run(sys.argv[2:], temporary, sys.argv[1])


def run(command: list[str], temporary: str, folder: str) -> int:
    """Run the command with its temporary files in a folder; its exit code."""
    child = subprocess.Popen(
        command,
        cwd=folder or None,
        stdin=subprocess.DEVNULL,
        start_new_session=sys.platform != "win32",
        env=os.environ | dict.fromkeys(("TMPDIR", "TEMP", "TMP"), temporary),
    )

    alone = threading.Event()

    def follow() -> None:
        while os.read(0, 4096):
            pass
        alone.set()
        end(child)

    def stop(number: int, frame: FrameType | None) -> None:
        end(child)

    # Ctrl-C reaches the whole foreground group; the parent decides what becomes of it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, stop)
    threading.Thread(target=follow, daemon=True).start()
    code = child.wait()
    if sys.platform != "win32":
        end(child)  # what it left behind
    if folder:
        tell(Path(folder), code)
        # Whoever is killed before he takes what was made leaves the folder to us.
        alone.wait()
        shutil.rmtree(folder, ignore_errors=True)
    return 128 - code if code < 0 else code


if __name__ == "__main__":
    sys.exit(main())
