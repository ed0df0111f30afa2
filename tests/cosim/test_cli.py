import json
import subprocess
import sys

import pytest


@pytest.mark.slow
def test_demo_shows_what_learning_gains_with_the_same_bytes_again(cosim, tmp_path):
    folders = [tmp_path / "a", tmp_path / "b"]
    for folder in folders:
        code, out, err = cosim("demo", "--samples", 480, "--steps", 1000, "--out", folder, "--json")
        assert code == 0, err
    summary = json.loads(out)
    rows = summary["controllers"]
    untrained = {"naive", "backed-off", "cautious"}
    rules = {"q-learning", "model-based"}
    assert set(rows) == untrained | rules | {"optimal"}
    # The story of README: caution costs little, and a rule takes most of that.
    assert rows["naive"]["J"] > rows["backed-off"]["J"] > rows["cautious"]["J"]
    assert rows["cautious"]["J"] > rows["model-based"]["J"]
    assert rows["naive"]["violating_share"] > 0.3
    for rule in rules:
        assert summary["training"][rule]["plant_samples"] == 480
        assert summary["training"][rule]["start"] == "cautious"
    files = [path for path in folders[0].rglob("*") if path.is_file()]
    names = {path.relative_to(folders[0]).as_posix() for path in files}
    expected = {"before-after.png", "evaluation.png", "evaluation.csv", "timing.csv"}
    expected |= {"summary.json", "scenario.toml", "demo.rrd"}
    of_a_rule = {"learning.png", "learning.csv", "parameters.toml", "scenario.toml", "training.rrd"}
    for rule in rules:
        expected |= {f"{rule}/{name}" for name in of_a_rule}
    assert names == expected
    for name in names - {"summary.json", "timing.csv"}:
        if not name.endswith(".rrd"):
            assert (folders[0] / name).read_bytes() == (folders[1] / name).read_bytes(), name


@pytest.mark.slow
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


def test_a_long_run_is_written_by_columns_and_drawn_when_asked_for(cosim, tmp_path, monkeypatch):
    assert cosim("simulate", "--steps", 20, "--out", "short")[0] == 0
    monkeypatch.setattr("cosim.cli.simulate.LONG_TABLE", 19)
    assert cosim("simulate", "--steps", 20, "--out", "long")[0] == 0
    beside = {"scenario.toml", "summary.json"}
    written = {path.name for path in (tmp_path / "short").iterdir()}
    assert written == beside | {"trajectory.csv", "timing.csv"}
    written = {path.name for path in (tmp_path / "long").iterdir()}
    assert written == beside | {"trajectory.parquet", "timing.parquet"}
    assert cosim("compare", "short", "long")[0] == 0
    code, _, err = cosim("simulate", "--steps", 20_001, "--plot", "--out", "long")
    assert code == 2 and "--plot draws 2 to 20000 samples" in err


@pytest.mark.slow
def test_a_picture_is_drawn_when_asked_for(cosim, tmp_path):
    assert cosim("simulate", "--steps", 20, "--plot", "--out", "drawn")[0] == 0
    assert (tmp_path / "drawn" / "trajectory.png").stat().st_size > 10_000


@pytest.mark.slow
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


LOADED = """
import sys; sys.argv[:1] = ["cosim", {words}]
from cosim.cli import main
try: main()
except SystemExit: pass
print(*sorted({heavy!r} & set(sys.modules)), file=sys.stderr)
"""
HEAVY = {"numpy", "pydantic", "casadi", "fmpy", "rerun", "matplotlib", "scipy", "filelock"}
NOT_RUN = {"scipy", "matplotlib"}


@pytest.mark.parametrize(
    ("words", "heavy"),
    [
        ("'--help'", HEAVY),
        ("'simulate','-n','1','-o'", NOT_RUN | {"pandas", "rerun"}),
        pytest.param("'simulate','--record','-n','1','-o'", NOT_RUN, marks=pytest.mark.slow),
    ],
)
def test_a_command_loads_no_library_that_it_does_not_need(tmp_path, words, heavy):
    code = LOADED.format(words=words, heavy=heavy)
    result = subprocess.run(
        [sys.executable, "-c", code, tmp_path], capture_output=True, text=True, check=True
    )
    assert result.stderr.splitlines()[-1] == ""


def test_a_run_is_not_mixed_with_another_commands(cosim, tmp_path):
    assert cosim("simulate", "--steps", 3, "--out", "one")[0] == 0
    kept = {path: path.read_bytes() for path in (tmp_path / "one").iterdir()}
    evaluate = ("evaluate", "--seeds", 2, "--steps", 3, "--jobs", 1, "--out", "one")
    code, _, err = cosim(*evaluate)
    assert code == 2 and "holds another run (trajectory.csv)" in err and err.count("\n") == 1
    assert kept == {path: path.read_bytes() for path in (tmp_path / "one").iterdir()}
    assert cosim(*evaluate, "--overwrite")[0] == 0
    left = {path.name for path in (tmp_path / "one").iterdir()}
    assert left == {"evaluation.csv", "timing.csv", "summary.json", "scenario.toml"}


def test_a_study_is_neither_replaced_by_a_run_nor_put_beside_one(cosim, tmp_path):
    for folder, file in (("study", "study.json"), ("run", "trajectory.csv")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / file).touch()
    code, _, err = cosim("simulate", "--steps", 3, "--out", "study", "--overwrite")
    assert code == 2 and "holds a study" in err
    (tmp_path / "mine.toml").write_text(
        'schema = 1\nname = "m"\nscenarios = ["paper"]\n'
        'evaluation = { seeds = 1, steps = 2 }\n[[case]]\ncontroller = "naive"\n'
    )
    code, _, err = cosim("study", "run", "mine.toml", "--out", "run")
    assert code == 2 and "no study (trajectory.csv)" in err


def test_a_refused_command_leaves_no_empty_folder(cosim, tmp_path):
    assert cosim("simulate", "-c", "nowhere", "--out", "a/b")[0] == 2
    assert not (tmp_path / "a").exists()
