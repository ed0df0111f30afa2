"""Retrain the outsiders and evaluate them beside the baselines: one command, one table.

    pip install 'rti-cosim[outsiders]'
    python examples/outsiders/retrain.py --out outsiders                 # the full budgets: minutes
    python examples/outsiders/retrain.py --out outsiders --share 0.01 --only sac,ppo

The study is results/outsiders.toml with the policies trained anew; `--share` scales every budget,
that of the evaluation included. A policy that is there already is not trained again, so the command
may be stopped and given again. The report is OUT/study/report.html.
"""

import argparse
import importlib.util
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import tomli_w

HERE = Path(__file__).resolve().parent
STUDY = HERE.parents[1] / "results" / "outsiders.toml"
BUDGETS = {"mpcrl": 3000, "sac": 30_000, "ppo": 200_000}
PACKAGES = {"mpcrl": "mpcrl", "sac": "stable_baselines3", "ppo": "stable_baselines3"}
LEAST = {"mpcrl": 50, "sac": 200, "ppo": 500}
"""Samples below which a library has made no update."""


def command(name, steps, seed, folder):
    script, target = "stable_baselines.py", folder
    first = [name]
    if name == "mpcrl":
        script, target, first = "mpcrl_agent.py", folder / "mpcrl.toml", []
    options = ["--steps", str(steps), "--seed", str(seed), "--out", str(target)]
    return [sys.executable, str(HERE / script), *first, *options]


def study_of(names, share, folder):
    """The stored study with the policies of this folder; returns the file."""
    document = tomllib.loads(STUDY.read_text("utf-8"))
    evaluation = document["evaluation"]
    evaluation["seeds"] = max(2, round(share * evaluation["seeds"]))
    evaluation["steps"] = max(100, round(share * evaluation["steps"]))
    places = {"mpcrl": "mpcrl.toml", "sac": "policy:sac", "ppo": "policy:ppo"}
    document["case"] = [
        {"controller": ["naive", "tuned"]},
        *({"name": n, "controller": places[n], "group": "outsiders"} for n in names),
    ]
    budgets = ", ".join(f"{n}: {samples(n, share)} plant samples" for n in names)
    document["description"] = f"Retrained here. {budgets}."
    file = folder / "outsiders.toml"
    file.write_text(tomli_w.dumps(document), "utf-8")
    # The study looks modules up in its own folder, and this one finds its weights beside itself.
    shutil.copy(HERE / "policy.py", folder / "policy.py")
    return file


def samples(name, share):
    return max(LEAST[name], round(share * BUDGETS[name]))


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("outsiders"))
    parser.add_argument("--share", type=float, default=1.0, help="of every budget")
    parser.add_argument("--only", default=",".join(BUDGETS), help="some of mpcrl,sac,ppo")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    names = [name.strip() for name in arguments.only.split(",") if name.strip()]
    if unknown := [name for name in names if name not in BUDGETS]:
        parser.error(f"--only: there is no outsider '{unknown[0]}'; there are {', '.join(BUDGETS)}")
    if not names or not 0 < arguments.share <= 1:
        parser.error("--only names at least one, and --share lies above 0 and not above 1")
    if missing := sorted({PACKAGES[n] for n in names if not importlib.util.find_spec(PACKAGES[n])}):
        parser.error(f"{', '.join(missing)} is not installed; pip install 'rti-cosim[outsiders]'")
    arguments.out.mkdir(parents=True, exist_ok=True)
    folder = arguments.out.resolve()
    for name in names:
        stored = folder / ("mpcrl.toml" if name == "mpcrl" else f"{name}.npz")
        if not stored.exists():
            steps = samples(name, arguments.share)
            print(f"{name}: {steps} plant samples", flush=True)
            subprocess.run(command(name, steps, arguments.seed, folder), check=True)
    study = str(study_of(names, arguments.share, folder))
    cosim = [sys.executable, "-m", "cosim", "study"]
    subprocess.run([*cosim, "run", study, "--out", str(folder / "study")], check=True)
    subprocess.run([*cosim, "report", str(folder / "study")], check=True)


if __name__ == "__main__":
    main()
