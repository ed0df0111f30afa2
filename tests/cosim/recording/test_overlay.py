import math
from dataclasses import replace

import numpy as np
from rerun.chunk import RrdReader

from cosim.comparison import RunSignals, compare
from cosim.recording import record_comparison
from cosim.stored_run import load_run
from cosim.trajectory import Signal


def run(name, **signals):
    return RunSignals(name, {key: Signal(key, "kPa", np.array(v)) for key, v in signals.items()})


def scalars(path):
    """Scalars by entity path, in order of their samples."""
    found = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        if "Scalars:scalars" in batch.schema.names:
            order = np.argsort(np.asarray(batch.column("sample")))
            found[chunk.entity_path] = batch.column("Scalars:scalars").flatten().to_numpy()[order]
    return found


def test_both_runs_and_their_difference_are_in_one_recording(tmp_path):
    a = run("a", time=[0.0, 60.0, 120.0], P2=[1.0, 2.0, 3.0])
    b = run("b", time=[0.0, 60.0, 120.0], P2=[1.0, 2.5, 3.0])
    record_comparison(tmp_path / "c.rrd", a, b, compare(a, b))
    found = scalars(tmp_path / "c.rrd")
    assert found["/A/P2"].tolist() == [1.0, 2.0, 3.0]
    assert found["/B/P2"].tolist() == [1.0, 2.5, 3.0]
    assert found["/difference/P2"].tolist() == [0.0, -0.5, 0.0]
    assert len(RrdReader(tmp_path / "c.rrd").recordings()) == 1


def test_runs_of_unequal_length_and_without_time_overlay(tmp_path):
    a, b = run("a", P2=[1.0, 2.0, 3.0], T=[0.0] * 3), run("b", P2=[1.0, 2.5])
    record_comparison(tmp_path / "c.rrd", a, b, compare(a, b))
    found = scalars(tmp_path / "c.rrd")
    assert found["/A/P2"].tolist() == [1.0, 2.0, 3.0]
    assert found["/B/P2"].tolist() == [1.0, 2.5]
    assert found["/difference/P2"].tolist() == [0.0, -0.5]
    assert "/A/T" not in found


def test_the_lines_have_the_runs_names_and_a_known_bound_is_drawn(tmp_path):
    a = replace(run("one/trajectory.csv", P2=[50.0, 60.0]), bounds={"P2": (40.0, math.inf)})
    b = run("two.rrd", P2=[50.0, 65.0])
    assert (a.label, b.label) == ("one", "two")
    record_comparison(tmp_path / "c.rrd", a, b, compare(a, b))
    found = scalars(tmp_path / "c.rrd")
    assert found["/bounds/P2/lower"].tolist() == [40.0, 40.0]
    assert "/bounds/P2/upper" not in found


def test_a_stored_run_knows_its_bounds(cosim, tmp_path):
    assert cosim("simulate", "--steps", 2, "--out", tmp_path / "r")[0] == 0
    assert load_run(tmp_path / "r").bounds["X2"] == (25.0, 100.0)
    (tmp_path / "r" / "scenario.toml").unlink()
    assert not load_run(tmp_path / "r").bounds
