import subprocess
import sys
import warnings

import numpy as np
import pytest
import rerun as rr

from cosim.errors import RecordingError
from cosim.recording import read_recording, read_signals, summarise
from tests.cosim.recording.test_run_recorder import recorded
from tests.helpers.blocks import random_block


def test_read_signals_gives_the_recordings_signals(tmp_path, paper, rng):
    recording = recorded(tmp_path / "run.rrd", paper, [random_block(paper, rng)])
    signals = read_signals(tmp_path / "run.rrd")
    assert list(signals) == list(recording.signals) == sorted(signals)
    assert all(np.array_equal(signals[n], recording.signals[n], equal_nan=True) for n in signals)


def test_the_summary_has_units_and_ranges(tmp_path, paper, rng, units):
    block = random_block(paper, rng)
    recorded(tmp_path / "run.rrd", paper, [block], units)
    summary = summarise(tmp_path / "run.rrd")
    assert summary["samples"] == 10
    assert summary["statuses"] == {"solved": 10}
    assert summary["signals"]["X2"] == {
        "unit": "%",
        "minimum": block["states"][:, 0].min(),
        "maximum": block["states"][:, 0].max(),
    }
    assert summary["signals"]["residual"]["minimum"] is None


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(RecordingError, match=r"there is no recording .*none\.rrd"):
        read_recording(tmp_path / "none.rrd")


def test_another_files_content_is_refused(tmp_path):
    path = tmp_path / "text.rrd"
    path.write_text("not a recording " * 100)
    with pytest.raises(RecordingError, match="not a readable recording"):
        read_recording(path)


def test_another_programs_recording_is_refused(tmp_path):
    path = tmp_path / "other.rrd"
    stream = rr.RecordingStream("other")
    stream.save(path)
    stream.log("a", rr.Scalars(1.0))
    stream.disconnect()
    with pytest.raises(RecordingError, match="holds no signals of rti-cosim"):
        read_recording(path)


@pytest.mark.slow
def test_what_a_killed_process_leaves_is_repaired_as_the_message_says(tmp_path, paper, rng):
    recorded(tmp_path / "run.rrd", paper, [random_block(paper, rng, 0, 3000)], steps=3000)
    torn = tmp_path / "torn.rrd"
    torn.write_bytes((tmp_path / "run.rrd").read_bytes()[:-2000])
    with (
        warnings.catch_warnings(action="error"),
        pytest.raises(RecordingError, match="rerun rrd optimize FILE -o REPAIRED"),
    ):
        read_recording(torn)
    repaired = tmp_path / "repaired.rrd"
    command = [sys.executable, "-m", "rerun", "rrd", "optimize", str(torn), "-o", str(repaired)]
    subprocess.run(command, check=True, capture_output=True)
    assert len(read_recording(repaired).samples) == 3000


def test_another_versions_recording_is_refused(tmp_path):
    path = tmp_path / "old.rrd"
    stream = rr.RecordingStream("old")
    stream.save(path)
    stream.log("a", rr.DynamicArchetype("cosim.Signal", components={"name": "X2"}), static=True)
    stream.disconnect()
    with pytest.raises(RecordingError, match="another version"):
        read_recording(path)
