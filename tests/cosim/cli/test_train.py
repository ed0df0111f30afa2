import json

import pytest
from PIL import Image
from typer.testing import CliRunner

from cosim.cli.main import app
from learning.training import Training

SHORT = (
    "train", "-a", "q-learning", "-n", 200, "--log-every", 50, "--evaluate-every", 100,
    "--checkpoint-every", 100, "--evaluation-seeds", 1, "--evaluation-steps", 30,
    "--set", "prior_samples=20", "--set", "step_every=20",
)  # fmt: skip


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short training with everything that it can write, and the JSON that it printed."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    words = (*SHORT, "--out", folder, "--seed", 5, "--record", "--json")
    ended = CliRunner().invoke(app, [*map(str, words)], catch_exceptions=False)
    return folder, json.loads(ended.stdout)


@pytest.fixture
def undrawn(monkeypatch):
    """For trainings whose picture nobody looks at."""
    monkeypatch.setattr(Training, "plot", lambda self, path: None)


def test_train_writes_theta_log_summary_and_recording(trained):
    folder, summary = trained
    assert summary == json.loads((folder / "summary.json").read_text())
    assert {"economic_cost", "mean_violation", "violating_share", "J", "failures"} <= set(summary)
    assert summary["hyperparameters"]["prior_samples"] == 20
    assert (summary["status"], summary["samples"], summary["seed"]) == ("finished", 200, 5)
    assert summary["regret"] is not None, "the optimum need not be named"
    assert summary["difference"] == pytest.approx(summary["J"] - summary["start_J"])
    assert (summary["verdict"], summary["updates"]) == ("no difference shown", 10)
    nothing = ("predicted_cost", "realised_cost", "changes")
    assert [summary[name] for name in nothing] == [None] * 3, "updated until its last sample"
    log = (folder / "learning.csv").read_text().splitlines()
    assert [row.split(",")[0] for row in log] == ["samples", "0", "50", "100", "150", "200"]
    assert (folder / "training.rrd").stat().st_size > 10_000


@pytest.mark.slow
def test_what_was_learned_is_a_controller(cosim, trained):
    folder, summary = trained
    code, out, _ = cosim("simulate", "-c", folder / "parameters.toml", "-n", 20, "--json")
    assert code == 0
    assert json.loads(out)["parameters_hash"] == summary["parameters_hash"]


@pytest.mark.slow
def test_the_same_command_and_seed_give_the_same_bytes(cosim, trained, tmp_path):
    assert cosim(*SHORT, "--out", "again", "--seed", 5, "--gif")[0] == 0
    with Image.open(tmp_path / "again/learning.gif") as animation:
        assert (animation.format, animation.n_frames) == ("GIF", 4)
    for file in ("learning.csv", "learning.png", "parameters.toml"):
        assert (tmp_path / "again" / file).read_bytes() == (trained[0] / file).read_bytes()


def test_explain_lists_every_hyperparameter(cosim):
    code, out, _ = cosim("train", "-a", "actor-critic", "--explain", "--json")
    assert code == 0
    assert json.loads(out)["radius"]["meaning"].startswith("trust region")


def test_explain_gives_each_meaning_the_width_of_the_terminal(cosim, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = cosim("train", "-a", "model-based", "--explain")
    lines = out.splitlines()
    assert code == 0 and max(map(len, lines)) <= 80
    place = lines.index("  exploration_decay_after = unset  (integer ≥ 1 or unset)")
    assert lines[place + 1].startswith("      samples T after which the share that explores falls")


@pytest.mark.slow
def test_divergence_ends_with_exit_code_1_and_says_why(cosim, undrawn, tmp_path):
    code, out, _ = cosim(
        "train", "-a", "q-learning", "-n", 6000, "--log-every", 500, "--evaluate-every", 1000,
        "--set", "rule=td", "--set", "step_size=1e-3", "--set", "scaled=false", "--out", "run",
        "--json", "--evaluation-seeds", 1, "--evaluation-steps", 200,
    )  # fmt: skip
    assert code == 1
    assert json.loads(out)["status"].startswith("diverged: ")
    assert (tmp_path / "run/parameters.toml").exists()


OWN = """
import helper_of_mine
from learning import QLearning

class Mine(QLearning):
    requires = "operation"
"""


@pytest.mark.slow
def test_a_run_of_an_edited_rule_is_not_resumed(cosim, undrawn, tmp_path):
    (tmp_path / "mine.py").write_text(OWN)
    (tmp_path / "helper_of_mine.py").write_text("X = 1\n")
    own = ("train", "-a", "mine:Mine", *SHORT[3:], "--out", "run")
    assert cosim(*own)[0] == 0
    assert json.loads((tmp_path / "run/summary.json").read_text())["requires"] == "operation"
    assert cosim(*own, "--resume")[0] == 0
    (tmp_path / "helper_of_mine.py").write_text("X = 2\n")
    code, _, err = cosim(*own, "--resume")
    assert code == 2 and "plug-in mine" in err
    assert len(err.strip().splitlines()) == 1
