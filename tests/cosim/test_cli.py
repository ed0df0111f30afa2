import json
import subprocess
import sys

import pytest


@pytest.mark.slow
def test_demo_shows_what_learning_gains_with_the_same_bytes_again(cosim, tmp_path):
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        code, out, err = cosim("demo", "--samples", 4000, "--steps", 100, "--out", folder, "--json")
        assert code == 0, err
    summary = json.loads(out)
    rows = summary["controllers"]
    assert set(rows) == {"naive", "tuned + back-off", "learnt", "optimal"}
    assert rows["optimal"]["J"] < rows["learnt"]["J"] < rows["naive"]["J"]
    assert rows["naive"]["violating_share"] > 0.3
    assert summary["training"]["plant_samples"] == 4000
    names = {path.name for path in folders[0].iterdir()}
    assert names == {
        "before-after.png",
        "demo.rrd",
        "evaluation.csv",
        "evaluation.png",
        "learning.csv",
        "learning.png",
        "parameters.toml",
        "scenario.toml",
        "summary.json",
        "timing.csv",
        "training.rrd",
    }
    for name in names - {"demo.rrd", "summary.json", "timing.csv", "training.rrd"}:
        assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes(), name


def test_json_is_all_that_goes_to_standard_output_and_equals_the_file(cosim, tmp_path):
    code, out, _ = cosim("simulate", "--steps", 30, "--seed", 4, "--out", "a", "--json")
    assert code == 0
    summary = json.loads(out)
    assert summary == json.loads((tmp_path / "a" / "summary.json").read_text())
    contract = {"economic_cost", "mean_violation", "violating_share", "J", "failures", "timing"}
    assert contract <= set(summary)
    assert (summary["controller"], summary["scenario"], summary["seed"]) == ("naive", "paper", 4)


def test_the_same_command_and_seed_write_the_same_bytes(cosim, tmp_path):
    for folder in ("a", "b"):
        assert cosim("simulate", "--steps", 50, "--seed", 3, "--out", folder)[0] == 0
    for name in ("trajectory.csv", "scenario.toml"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    one, two = (json.loads((tmp_path / f / "summary.json").read_text()) for f in ("a", "b"))
    assert one.pop("timing") != two.pop("timing")
    assert one == two


def test_a_written_scenario_repeats_the_run(cosim, tmp_path):
    assert cosim("simulate", "-s", "fast-sampling", "--steps", 50, "--out", "a")[0] == 0
    assert cosim("simulate", "-s", "a/scenario.toml", "--steps", 50, "--out", "b")[0] == 0
    files = [(tmp_path / folder / "trajectory.csv").read_bytes() for folder in ("a", "b")]
    assert files[0] == files[1]


def test_a_foreign_fmu_is_announced_with_its_hash(cosim, tmp_path):
    import hashlib

    import fmus

    data = fmus.path().read_bytes()
    (tmp_path / "mine.fmu").write_bytes(data)
    (tmp_path / "mine.toml").write_text('extends = "paper"\n[plant]\nfmu = "mine.fmu"\n')
    code, _, err = cosim("simulate", "-s", "mine.toml", "--steps", 5, "--out", "a")
    assert code == 0
    assert hashlib.sha256(data).hexdigest() in err.replace("\n", "")
    assert "native code" in err
    assert "native code" not in cosim("simulate", "--steps", 5, "--out", "a")[2]


def test_scenario_lists_the_presets_and_prints_one(cosim, paper):
    code, out, _ = cosim("scenario")
    assert code == 0
    assert "fast-sampling" in out
    assert cosim("scenario", "paper")[1] == f"# hash {paper.hash}\n{paper.to_toml()}"
    assert json.loads(cosim("scenario", "--json")[1])["presets"]["paper"] == paper.hash


def test_version_gives_the_fmus_hashes(cosim):
    import hashlib

    import fmus

    _, out, _ = cosim("--version")
    assert out.startswith("cosim 0.")
    assert hashlib.sha256(fmus.path("evaporator_fmi3").read_bytes()).hexdigest() in out


def test_help_loads_no_numerics():
    code = (
        "import sys; sys.argv = ['cosim', '--help']\n"
        "from cosim.cli import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "heavy = {'numpy', 'pydantic', 'casadi', 'fmpy', 'rerun', 'matplotlib', 'scipy'}\n"
        "print(sorted((heavy | {'filelock'}) & set(sys.modules)), file=sys.stderr)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert result.stderr.strip() == "[]"


def test_a_short_run_loads_no_scipy(tmp_path):
    """Importing it takes as long as all the rest of `simulate --steps 1`."""
    code = (
        "import sys; sys.argv[:1] = ['cosim', 'simulate', '--steps', '1', '--out']\n"
        "from cosim.cli import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print('scipy' in sys.modules, file=sys.stderr)"
    )
    result = subprocess.run(
        [sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True
    )
    assert (tmp_path / "summary.json").is_file()
    assert result.stderr.splitlines()[-1] == "False"
