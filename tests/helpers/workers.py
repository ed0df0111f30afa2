"""Tasks and controllers that ruin their worker, at module level so that workers can import them."""

import os
import signal
import time
from contextlib import suppress
from pathlib import Path

from cosim.core.errors import CosimWarning, warn
from tests.helpers.loop import Proportional

LEDGER = "COSIM_TEST_LEDGER"


def die(_):
    os.kill(os.getpid(), signal.SIGKILL)


class Noting(Proportional):
    """Writes a line to the ledger for every run, before it starts."""

    def reset(self):
        with Path(os.environ[LEDGER]).open("a") as ledger:
            ledger.write(f"{os.getpid()}\n")
        super().reset()


def noting(scenario):
    return Noting(scenario)


class Mortal(Noting):
    """From the third run on, the first worker to start one is killed."""

    def reset(self):
        super().reset()
        ledger = Path(os.environ[LEDGER])
        if len(ledger.read_text().split()) >= 3:
            with suppress(FileExistsError):
                ledger.with_suffix(".death").touch(exist_ok=False)
                die(None)


def mortal(scenario):
    return Mortal(scenario)


def warning(scenario):
    warn("this controller warns", CosimWarning)
    return Proportional(scenario)


class Dying(Proportional):
    def reset(self):
        die(None)


def always_dying(scenario):
    return Dying(scenario)


class Sluggish(Proportional):
    def feedback(self, s, a=None):
        time.sleep(0.02)
        return super().feedback(s, a)


def sluggish(scenario):
    return Sluggish(scenario)
