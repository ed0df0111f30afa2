"""Malformed tables of sensors and signals: one line, exit 2, before the first sample."""

import pytest

HEAD = 'extends = "paper"\nschema = 1\nname = "bad"\n'
X2 = '[[sensor]]\nvariable = "X2"\n'
SIGNAL = '[[signal]]\nname = "a"\n'
BOUND = 'bound = "x_l[X2]"\n'

TABLES = {
    "a part of a sample": (X2 + "every = 1.5\n", "sensor[0].every: must be a valid integer"),
    "a reading before it is taken": (X2 + "delay = -1\n", "greater than or equal to 0, not -1"),
    "noise that is no number": (X2 + "deviation = nan\n", "must be a finite number, not nan"),
    "noise beyond all numbers": (X2 + "deviation = 1e400\n", "must be a finite number, not inf"),
    "two of one variable": (X2 + X2, "two of them read 'X2'"),
    "a variable of nothing": (X2.replace("X2", "X22"), "no variable 'X22' (did you mean 'X2'?)"),
    "no variable": ("[[sensor]]\n", "sensor[0].variable: is missing"),
    "a slip of the pen": (X2 + "evry = 3\n", "did you mean 'every'?"),
    "no list": ("sensor = 3\n", "sensor: must be a list"),
    "a reading after the run": (X2 + "delay = 500\n", "is never read"),
    "an action": (X2.replace("X2", "P100"), "neither a state nor an output"),
    "deviations of other sensors": (
        X2 + "[estimator]\nsensor_deviation = [0.1, 0.2]\n",
        "must have one entry per sensor (1), not 2",
    ),
    "deviations of other disturbances": (
        X2 + "[estimator]\ndisturbance_deviation = [1.0]\n",
        "must have 4 entries, not 1",
    ),
    "an estimator of nothing": ('[estimator]\nkind = "ekf"\n', "there is no [[sensor]]"),
    "an estimator from nowhere": (
        X2 + '[estimator]\nkind = "nowhere:factory"\n',
        "no module 'nowhere'",
    ),
    "a hot word": (
        SIGNAL + 'file = "text.csv"\nperiod = 600.0\n' + BOUND,
        "line 3: a is no finite",
    ),
    "a binary file": (SIGNAL + 'file = "binary.csv"\nperiod = 600.0\n' + BOUND, "cannot be read"),
    "a time twice": (
        SIGNAL + 'file = "times.csv"\nperiod = 600.0\n' + BOUND,
        "times must increase",
    ),
    "two columns": (SIGNAL + 'file = "two.csv"\nperiod = 600.0\n' + BOUND, "several columns 'a'"),
    "a truth": (SIGNAL + "values = [true]\nperiod = 600.0\n" + BOUND, "must be a valid number"),
    "an end before the run's": (SIGNAL + "values = [25.0]\nonce = 600.0\n" + BOUND, "ends after"),
    "a preview beyond the end": (
        SIGNAL + 'values = [25.0]\nonce = 1260.0\nknown = "preview"\n' + BOUND,
        "with a preview of 10 needs 1800 s",
    ),
    "shorter than a sample": (
        SIGNAL + "values = [25.0, 26.0]\nperiod = 90.0\n" + BOUND,
        "a value lasts 45 s",
    ),
    "another knowledge": (
        SIGNAL + 'values = [25.0]\nperiod = 600.0\nknown = "soon"\n' + BOUND,
        "must be 'none', 'now' or 'preview'",
    ),
    "what no model has": (
        SIGNAL + 'values = [25.0]\nperiod = 600.0\nmodel = "X7"\nknown = "now"\n',
        "has no disturbance or parameter 'X7'",
    ),
    "a measured output": (
        SIGNAL + 'measures = "F2"\nmodel = "X1"\nknown = "now"\n',
        "none of plant.disturbances",
    ),
}
FILES = {
    "text.csv": b"a\n25\nhot\n",
    "binary.csv": b"\xff\xfe\x00\x01a\n",
    "times.csv": b"time,a\n0,25\n0,26\n",
    "two.csv": b"a,a\n25,26\n",
}


@pytest.mark.parametrize("case", TABLES)
def test_a_malformed_table_is_one_line_before_the_first_sample(case, cosim, tmp_path):
    table, message = TABLES[case]
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content)
    path = tmp_path / "bad.toml"
    path.write_text(HEAD + table)
    out = tmp_path / "out"
    code, output, errors = cosim(
        "simulate", "-s", str(path), "-c", "naive", "--steps", "20", "--out", str(out)
    )
    assert (code, output) == (2, "")
    assert message in errors
    assert errors.count("\n") == 1
    # It is the only one.
    assert "more problem" not in errors
    assert not list(out.rglob("*"))
