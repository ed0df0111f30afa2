"""Draw the pictures of README and the pages: `python docs/pictures.py`, a minute.

`regret.png` and those of docs/results.md are drawn from the tables in `results/`. Those of
examples/teaching.md are drawn from a training and from runs that this file makes.
"""

from pathlib import Path
from shutil import copyfile

import cosim
from cosim.core.files import temporary_folder
from cosim.core.training_options import HELD_OUT
from cosim.figures.bars import Bar, bars_figure
from cosim.figures.style import REFERENCE, palette, save
from cosim.figures.trajectory import overlay_figure
from cosim.studies.stored import draw_stored

ROOT = Path(__file__).parents[1]
IMAGES = ROOT / "docs" / "images"
SCENARIO = "fouled"
HOUR = 60
"""Samples: one a minute."""
RULES = {
    "offset-free MPC": ("operation-headline", "offset-free"),
    "Q-learning": ("operation-intercept", "q-learning(start=cautious)"),
    "model-based rule": ("operation-headline", "model-based(start=cautious)"),
}
"""Study and case of each name in the picture; all start from cautious."""
# A training that starts from naive has other slack weights than the controller.
UNTRAINED = {
    "naive MPC": ("operation-headline", "naive"),
    "backed-off MPC": ("operation-headline", "fixed(start=backed-off)"),
    "cautious MPC": ("operation-headline", "fixed(start=cautious)"),
}

RESULTS = {
    "headline-fouled": ("operation-headline", "operation-fouled"),
    "intercept-fouled": ("operation-intercept", "operation-fouled"),
    "gains-holdup": ("operation-gains", "operation-holdup"),
    "plants-jump": ("operation-plants", "operation-jump"),
    "outsiders-paper": ("outsiders", "regret-paper"),
    "printed-rule": (
        "learning",
        "parameters-paper-printed(value_offset=discounted_exploration=additive)",
    ),
}
"""Study and figure of each picture of docs/results.md."""


def regrets(study: str) -> dict[tuple[str, int], float]:
    """Median greedy regret over the training seeds in %, by case and samples."""
    results = cosim.StudyResults.load(ROOT / "results" / study)
    runs = results.operation_result(SCENARIO).runs
    medians = runs.groupby(["case", "samples"]).regret.median()
    # The naive controller does not learn: it was evaluated once, if at all.
    evaluated = results.runs[results.runs.scenario == SCENARIO].set_index("case").regret
    if "naive" in evaluated:
        medians["naive", 24 * HOUR] = evaluated["naive"]
    return {key: 100 * value for key, value in medians.items()}


def draw_regret() -> None:
    """Regret without data, after a day, after a week: what README shows first."""
    tables = {name: regrets(name) for name in ("operation-headline", "operation-intercept")}
    cases = [case for _, case in RULES.values()]
    colors = palette(cases)
    groups = {}
    for heading, members, hours in (
        ("No data: the controller's model alone", UNTRAINED, 24),
        ("After one day of operation", RULES, 24),
        ("After one week", RULES, 168),
    ):
        bars = []
        for name, (study, case) in members.items():
            regret = tables[study][case, hours * HOUR]
            # A rule has its colour of all figures; what has not learned is grey.
            color = colors[case].color if members is RULES else REFERENCE
            bars.append(Bar(name, regret, color))
        groups[heading] = bars
    figure = bars_figure(
        groups,
        title="How far is each controller from the best possible?",
        axis_label="cost above the least possible, in % (log scale)",
    )
    save(figure, IMAGES / "regret.png")


def draw_results() -> None:
    """The figures of stored studies that docs/results.md shows, as `cosim results draw` does.

    A clone has no figures of studies, since they follow from the tables.
    """
    for name, (study, figure) in RESULTS.items():
        draw_stored(ROOT / "results", study)
        drawn = ROOT / "results" / study / "figures" / f"{figure}.svg"
        copyfile(drawn, IMAGES / f"{name}.svg")


def draw_teaching() -> None:
    """A training of Q-learning, and the same disturbances before and after it."""
    training = cosim.train("q-learning", SCENARIO, 20_000, start="tuned", evaluate_every=2000)
    training.plot(IMAGES / "learning.png")
    scenario = cosim.Scenario.load(SCENARIO)
    runs = {}
    with cosim.FmuPlant(scenario) as plant, temporary_folder("pictures-") as folder:
        learned = training.parameters.save(folder / "learned.toml")
        for name, source in (("naive", "naive"), ("learned", learned), ("optimal", "optimal")):
            controller = cosim.build_controller(str(source), scenario)
            # Noise that no training met.
            runs[name] = cosim.simulate(plant, controller, 500, 2 * HELD_OUT)
    save(overlay_figure(runs), IMAGES / "before-after.png")


if __name__ == "__main__":
    draw_regret()
    draw_results()
    draw_teaching()
