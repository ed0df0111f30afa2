"""A trainer without learning: a gain that grows with the samples, in checkpointed pieces."""

import json

from cosim import Study
from cosim.errors import StudyError
from cosim.study.protocols import Progress
from tests.helpers.loop import Hold, Proportional

PIECE = 500


class ToyTrainer:
    """θ is one gain; its randomness is the seed's. `algorithm` says what goes wrong, if anything.

    `grow` learns, `diverge` gives up halfway, `break` raises, `interrupt` is stopped by the user
    once, in the file that `settings["marker"]` names.
    """

    def check(self, training):
        if training.algorithm not in ("grow", "diverge", "break", "interrupt"):
            raise StudyError(f"unknown algorithm '{training.algorithm}'")

    def takes_list(self, algorithm, setting):
        return setting == "weights"

    def advance(self, training, checkpoint, seconds):
        state = json.loads(checkpoint) if checkpoint else {"samples": 0, "gain": 0.0, "log": ""}
        reached = min(state["samples"] + PIECE, training.samples)
        state["gain"] += (reached - state["samples"]) / 1000 * training.settings.get("rate", 1.0)
        state["samples"] = reached
        state["log"] += (
            f"{reached},{7000 - state['gain'] - training.seed},{6900 - state['gain']},1\n"
        )
        if training.algorithm == "break":
            raise ZeroDivisionError("broken in the middle")
        if training.algorithm == "interrupt" and reached > PIECE:
            self._interrupt_once(training.settings["marker"])
        stopped = training.algorithm == "diverge" and reached >= training.samples / 2
        if reached < training.samples and not stopped:
            return Progress(reached, checkpoint=json.dumps(state).encode(), wall_seconds=0.1)
        return Progress(
            reached,
            "diverged: as told" if stopped else "finished",
            log="samples,J,greedy_J,td_error\n" + state["log"],
            parameters=json.dumps({"gain": state["gain"], "seed": training.seed}),
            plant_samples=reached + 7,
            wall_seconds=0.1,
        )

    @staticmethod
    def _interrupt_once(marker):
        from pathlib import Path

        try:
            Path(marker).touch(exist_ok=False)
        except FileExistsError:
            return
        raise KeyboardInterrupt

    def policy(self, training, parameters):
        theta = json.loads(parameters)
        return Proportional(training.scenario, gain=theta["gain"] + theta["seed"])

    def scales(self, training):
        return {"theta g": 2.0, "theta h[0]": 1.0}

    def controller(self, name, scenario):
        controllers = {"naive": Hold(scenario.reference_action), "best": Proportional(scenario)}
        return controllers[name]

    def optimum(self, scenario):
        return "best"

    def sources(self, target):
        return {}


def document(**changes):
    return {
        "schema": 1,
        "name": "toy",
        "scenarios": ["paper"],
        "training_seeds": {"first": 0, "count": 2},
        "evaluation": {"seeds": 3, "steps": 30},
        "curves": {"points": 4, "seeds": 2, "steps": 20},
        "case": [
            {
                "name": "grow",
                "algorithm": "grow",
                "samples": 1200,
                "settings": {"rate": [1.0, 2.0]},
            },
            {"controller": ["naive", "best"]},
        ],
    } | changes


def study(folder=".", **changes):
    return Study.from_dict(document(**changes), folder, trainer=ToyTrainer())
