"""What stands where a command reads or writes: one line, nothing harmed, no wait without end."""

import os
import signal

import numpy as np
import pytest

from controllers.factories import naive
from cosim import FmuPlant, Scenario, simulate
from tests.helpers.loop import Proportional

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="FIFOs and devices of POSIX"),
]
PAPER = Scenario.load("paper")


@pytest.fixture
def limited():
    """A limit of two minutes; SIGALRM's own effect would end the tests."""

    def late(*_):
        raise TimeoutError("the command waits")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


PLACES = {
    "a FIFO": os.mkfifo if hasattr(os, "mkfifo") else None,
    "a device": lambda path: path.symlink_to("/dev/null"),
    "a folder": lambda path: (path.mkdir(), (path / "precious").write_text("precious")),
    "a link to itself": lambda path: path.symlink_to(path.name),
    "below a file": lambda path: path.parent.rmdir() or path.parent.write_text("precious"),
}
CONTENTS = {
    "nothing": b"",
    "zeros": bytes(4096),
    "an archive's head": b"PK\x03\x04" + bytes(40),
    "a recording's head": b"RRF2" + bytes(40),
}
READING = [
    "simulate -s {}",
    "evaluate -c {}",
    "train -a q-learning -n 20 --start {}",
    "tuning -s {}",
    "optimum -s {}",
    "export {} --local --out new.fmu",
    "study run {}",
    "compare {0} {0}",
    "view {} --png new.png",
    "fmu info {}",
    "fmu check {}",
    "scenario init {} --out new.toml",
]
WRITING = [
    "tuning --out {}",
    "export tuned --local --out {}",
    "export tuned --local --out new.fmu --ssp {}",
    "compare a b --record {}",
    "scenario init evaporator --out {}",
]


def seen(folder):
    return {
        path: path.read_bytes()
        if path.is_file() and not path.is_symlink()
        else path.lstat().st_mode
        for path in folder.rglob("*")
    }


@pytest.mark.parametrize("kind", [*PLACES, *CONTENTS])
@pytest.mark.parametrize("words", READING)
def test_an_input_of_any_kind_is_refused(cosim, limited, tmp_path, words, kind):
    suffix = ".rrd" if "view" in words else ".fmu" if "fmu" in words else ".toml"
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / f"given{suffix}"
    path.write_bytes(CONTENTS[kind]) if kind in CONTENTS else PLACES[kind](path)
    before = seen(tmp_path)
    code, _, err = cosim(*words.format("in/" + path.name).split())
    assert (code, err.count("error: ")) == (2, 1), err
    assert before.items() <= seen(tmp_path).items()


@pytest.mark.parametrize("kind", [kind for kind in PLACES if "link" not in kind])
@pytest.mark.parametrize("words", WRITING)
def test_an_output_never_replaces_what_is_no_file(cosim, limited, tmp_path, words, kind):
    for name in "ab" if "compare" in words else "":
        (tmp_path / name).mkdir()
        with FmuPlant(PAPER) as plant:
            simulate(plant, Proportional(PAPER), 3, 0).write_csv(tmp_path / name / "trajectory.csv")
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / ("given.rrd" if "compare" in words else "given.toml")
    PLACES[kind](path)
    before = seen(tmp_path)
    code, _, err = cosim(*words.format("in/" + path.name).split())
    assert (code, err.count("error: ")) == (2, 1), err
    assert before.items() <= seen(tmp_path).items()


@pytest.mark.parametrize("kind", [np.int8, np.int64, np.uint64])
def test_a_seed_may_be_any_integer(kind):
    with FmuPlant(PAPER) as plant:
        controller = naive(PAPER)
        rows = [simulate(plant, controller, 3, seed).states for seed in (kind(1), 1)]
    assert np.array_equal(*rows)
