"""Where a picture of a recording stands, if nobody says where."""

import pytest

from cosim.recording.moment import telling_moment
from tests.cosim.recording.test_run_recorder import recorded
from tests.helpers.blocks import random_block


@pytest.mark.parametrize(("violation", "sample"), [(0.0, 9), (1e-9, 9), (0.5, 4)])
def test_a_run_is_shown_at_its_worst_violation_or_at_its_end(
    tmp_path, paper, rng, violation, sample
):
    block = random_block(paper, rng)
    block["violation"][:] = 0.0
    block["violation"][4] = violation
    recorded(tmp_path / "run.rrd", paper, [block])
    assert telling_moment(tmp_path / "run.rrd") == pytest.approx(sample * paper.sampling_time)


def test_a_file_that_cannot_be_read_has_no_moment(tmp_path):
    (tmp_path / "no.rrd").write_bytes(b"nothing")
    assert telling_moment(tmp_path / "no.rrd") is None
    assert telling_moment(tmp_path / "none.rrd") is None


def test_a_training_is_shown_at_its_last_theta(cosim, tmp_path):
    short = ("-n", 200, "--log-every", 50, "--evaluate-every", 100, "--checkpoint-every", 100)
    few = ("--evaluation-seeds", 1, "--evaluation-steps", 20)
    code, _, _ = cosim("train", "-a", "q-learning", *short, *few, "--out", tmp_path, "--record")
    assert code == 0
    assert telling_moment(tmp_path / "training.rrd") == 200
