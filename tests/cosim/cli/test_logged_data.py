"""`cosim shadow` and `cosim train --data`: their files, their refusals, their exit codes."""

import json

import pytest

from cosim import FmuPlant, build_controller, simulate
from cosim.shadow import Shadow


@pytest.fixture(scope="module")
def log(paper, tmp_path_factory):
    """The log of a PI controller."""
    with FmuPlant(paper) as plant:
        run = simulate(plant, build_controller("pi", paper), 150, 0)
    return run.write_csv(tmp_path_factory.mktemp("log") / "log.csv")


def test_shadow_writes_its_files(cosim, log, tmp_path, monkeypatch):
    monkeypatch.setattr(Shadow, "plot", lambda self, path: path.touch())
    code, out, _ = cosim("shadow", "pi", "--data", log, "--out", "shadow", "--json")
    assert code == 0
    summary = json.loads(out)
    assert summary == json.loads((tmp_path / "shadow/summary.json").read_text())
    assert summary["samples"] == 150
    assert summary["doubts"] == []
    assert {path.name for path in (tmp_path / "shadow").iterdir()} == {
        "shadow.csv",
        "shadow.png",
        "summary.json",
        "scenario.toml",
    }
    header = (tmp_path / "shadow/shadow.csv").read_text().splitlines()[0]
    assert header == "time [s],X2,P2,P100,proposed[P100],F200,proposed[F200],status"


def test_a_shadow_says_what_a_training_would_refuse(cosim, log, tmp_path):
    header, *rows = [line.split(",") for line in log.read_text().splitlines()]
    place = header.index("P2 [kPa]")
    for row in rows:
        row[place] = repr(1.8 * float(row[place]) + 32.0)
    path = tmp_path / "other_unit.csv"
    path.write_text("\n".join(map(",".join, [header, *rows])) + "\n")
    code, _, err = cosim("shadow", "pi", "--data", path, "--out", "shadow")
    refused, _, message = cosim("train", "-a", "model-based", "--data", path, "--out", "trained")
    assert (code, refused) == (0, 2)
    (doubt,) = [line for line in err.splitlines() if line.startswith("in doubt")]
    assert "another unit" in doubt and doubt.split(": ", 1)[1] in message


@pytest.mark.slow
def test_the_same_shadow_has_the_same_bytes(cosim, log, tmp_path):
    for folder in ("one", "two"):
        assert cosim("shadow", "tuned", "--data", log, "--record", "--out", folder)[0] == 0
    for name in ("shadow.csv", "shadow.png", "summary.json"):
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()
    assert (tmp_path / "one/shadow.rrd").stat().st_size > 10_000


TRAIN = ("train", "--algorithm", "model-based", "--data")
REFUSED = {
    "column": (("shadow", "tuned", "--column", "P2=PI-1", "--data"), "no column 'PI-1'"),
    "variable": (("shadow", "tuned", "--column", "P3=PI-1", "--data"), "no variable 'P3'"),
    "plant": ((*TRAIN[:-1], "--samples", 100, "--data"), "--samples has no part"),
    "rule": (("train", "-a", "q-learning", "--data"), "q-learning cannot learn from logged data"),
    "sensors": ((*TRAIN[:-1], "--scenario", "late", "--data"), "no column 'measured[X2]'"),
    "signals": ((*TRAIN[:-1], "--scenario", "prices", "--data"), "has signals"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_is_refused_in_one_line(cosim, log, case):
    words, message = REFUSED[case]
    code, out, err = cosim(*words, log, "--out", "run")
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1


def test_columns_without_data_are_refused(cosim):
    code, _, err = cosim("train", "-a", "model-based", "--column", "P2=x", "--out", "run")
    assert code == 2
    assert "--column belongs to --data" in err
