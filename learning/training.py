"""The training loop: samples, log, greedy evaluation, checkpoints, early stop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from controllers.parameters import Parameters
from controllers.problem import Problem
from controllers.storage import write_atomically
from cosim.errors import CapabilityError
from cosim.plant import FmuPlant
from cosim.protocols import Controller
from cosim.simulation import spawn_seeds
from learning import checkpoint
from learning.checkpoint import Checkpoint
from learning.definiteness import certificate
from learning.errors import ConfigurationError, DivergenceError
from learning.evaluation import Evaluation, gap_closed, held_out
from learning.interaction import Interaction
from learning.log import COLUMNS, Row, Totals, to_csv
from learning.protocols import Algorithm
from learning.run import Result, Run, TrainingRecorder
from learning.starting_point import build_controller, build_strategy, starting_parameters


class Training:
    """One run of one algorithm on one plant.

    `plant` and `evaluation_plant` are two plants of the run's scenario. `optimum` is a controller
    whose J on the held-out runs is J*, for the gap closed; without it the gap is NaN. With `out`,
    learning.csv, parameters.toml and checkpoint.npz are kept there as the run goes on; a plant
    that cannot serialise its state leaves no checkpoint, and `obstacle` says so.
    """

    def __init__(
        self,
        run: Run,
        algorithm: type[Algorithm],
        plant: FmuPlant,
        evaluation_plant: FmuPlant,
        *,
        optimum: Controller | None = None,
        out: Path | None = None,
        recorder: TrainingRecorder | None = None,
    ) -> None:
        scenario, configuration = run.scenario, run.configuration
        self._run, self._plant, self._out, self._recorder = run, plant, out, recorder
        problem = Problem.from_scenario(cast("Any", scenario))
        parameters = starting_parameters(problem, configuration)
        self._controller = build_controller(run.controller, scenario, problem, parameters)
        self._greedy = build_controller(run.controller, scenario, problem, parameters)
        strategy = build_strategy(configuration, scenario, run.samples)
        self._algorithm = algorithm(
            self._controller, scenario, configuration, run.samples, strategy
        )
        plant_seed, self._rng = spawn_seeds(run.seed)
        self._interaction = Interaction(
            plant, self._controller, self._algorithm, strategy, self._rng
        )
        self._plant_seed = plant_seed
        self._evaluation = Evaluation(
            cast("Any", evaluation_plant), held_out(run.evaluation_seeds), run.evaluation_steps
        )
        self._optimum = optimum
        self._naive = build_controller(run.controller, scenario, problem, Parameters.naive(problem))
        self._rows: list[Row] = []
        self._good = parameters
        self._totals = Totals()
        self.obstacle: str | None = None
        """Why this run leaves no checkpoint, if it does not."""
        self._references = {"naive": float("nan"), "optimum": float("nan")}

    def go(
        self, *, resume: bool = False, progress: Callable[[int, Row | None], None] | None = None
    ) -> Result:
        """Train to the end or to divergence; `progress` gets the samples done and the last row.

        With `resume` the run goes on from its checkpoint, to the same digits as if it had never
        stopped; raises CheckpointError where there is none that fits.
        """
        self._references["naive"] = self._judge(self._naive)["J"]
        if self._optimum is not None:
            self._references["optimum"] = self._evaluation.means(self._optimum)["J"]
        if resume:
            self._resume()
        else:
            self._interaction.start(self._plant_seed)
            self._checkpoint()
        if self._recorder is not None:
            self._recorder.start(self._run, self._good)
            for row in self._rows:
                self._record(row)
        try:
            status = self._loop(progress)
        finally:
            if self._recorder is not None:
                self._recorder.close()
        self._greedy.theta = self._good.theta
        return Result(self._good, self._rows, self._judge(self._greedy), status)

    def _loop(self, progress: Callable[[int, Row | None], None] | None) -> str:
        run, interaction, algorithm = self._run, self._interaction, self._algorithm
        totals = self._totals
        while interaction.number < run.samples:
            sample, cost = interaction.next()
            totals.cost += cost
            if sample is not None:
                try:
                    update = algorithm.observe(sample)
                except DivergenceError as error:
                    return f"diverged: {error} at sample {interaction.number}"
                if update is not None:
                    totals.add(update)
                    interaction.renew()
            number = interaction.number
            if number % run.log_every and number < run.samples:
                continue
            row = self._row(number)
            self._rows.append(row)
            if self._recorder is not None:
                self._record(row)
            if trouble := self._trouble(row):
                return trouble
            if not isnan(row["greedy_J"]):
                self._good = self._controller.parameters
            if number % run.checkpoint_every == 0 or number == run.samples:
                self._checkpoint()
            if progress is not None:
                progress(number, row)
        return "finished"

    def _row(self, number: int) -> Row:
        """A line of the log: what happened since the last one, and now and then an evaluation."""
        run, interaction = self._run, self._interaction
        layout, theta = self._controller.parameters.layout, self._controller.theta
        row: Row = dict.fromkeys(COLUMNS, float("nan"))
        row |= self._totals.means(number - (self._rows[-1]["samples"] if self._rows else 0))
        row |= {
            "samples": number,
            # The least certificate of the updates since the last row, whichever step gave it.
            "smallest_eigenvalue": min(
                self._totals.smallest_eigenvalue, certificate(layout, theta).smallest
            ),
            "failures": interaction.failures,
            "explored": interaction.explored,
            "saturated": interaction.saturated,
        }
        if number % run.evaluate_every == 0 or number == run.samples:
            self._greedy.theta = theta
            figures = self._judge(self._greedy)
            row |= {f"greedy_{name}": value for name, value in figures.items()}
            row["gap_closed"] = gap_closed(
                figures["J"], self._references["naive"], self._references["optimum"]
            )
        row |= {f"theta {label}": float(v) for label, v in zip(layout.labels, theta, strict=True)}
        self._totals.clear()
        return row

    def _judge(self, controller: Any) -> dict[str, float]:
        return self._evaluation.means(controller)

    def _trouble(self, row: Row) -> str | None:
        """Why the run must stop, or None."""
        naive = self._references["naive"]
        # A cost may be negative, a profit say: the margin counts in its magnitude.
        limit = naive + (self._run.divergence - 1) * abs(naive)
        where = f"at sample {int(row['samples'])}; the θ kept is the last one that evaluated well"
        if not np.isfinite(self._controller.theta).all():
            return f"diverged: θ is not finite {where}"
        if row["greedy_J"] > limit:
            return f"diverged: greedy J = {row['greedy_J']:.1f} exceeds {limit:.1f} {where}"
        return None

    def _record(self, row: Row) -> None:
        assert self._recorder is not None
        labels = self._controller.parameters.layout.labels
        theta = np.array([row[f"theta {label}"] for label in labels])
        parameters = self._controller.parameters.with_theta(theta)
        self._greedy.theta = theta
        self._recorder.record(row, parameters, cast("Controller", self._greedy))

    # Checkpoints --------------------------------------------------------------------------------

    def _checkpoint(self) -> None:
        """Write the state to disk and start the solver afresh, as a resumed run will."""
        self._interaction.restart()
        if self._out is None:
            return
        self.write(self._good)
        try:
            plant = self._plant.serialise(self._plant.snapshot())
        except CapabilityError as error:
            self.obstacle = str(error)
            return
        numbers, arrays = self._interaction.state()
        columns = list(self._rows[0]) if self._rows else []
        stored = {f"interaction {name}": value for name, value in arrays.items()}
        stored |= {f"algorithm {name}": value for name, value in self._algorithm.state().items()}
        stored |= {
            "theta": self._controller.theta,
            "good": self._good.theta,
            "plant": np.frombuffer(plant, dtype=np.uint8),
            "rows": np.array([[row[name] for name in columns] for row in self._rows]),
        }
        state = {
            "interaction": numbers,
            "totals": asdict(self._totals),
            "generator": checkpoint.generator_state(self._rng),
            "columns": columns,
        }
        checkpoint.save(
            self._out / "checkpoint.npz", Checkpoint(self._run.identity(), state, stored)
        )

    def _resume(self) -> None:
        if self._out is None:
            raise ConfigurationError("a run without a folder cannot be resumed")
        found = checkpoint.load(self._out / "checkpoint.npz", self._run.identity())
        state, arrays = found.state, found.arrays
        checkpoint.restore_generator(self._rng, state["generator"])
        self._rows = [
            dict(zip(state["columns"], (float(v) for v in row), strict=True))
            for row in arrays["rows"]
        ]
        self._totals = Totals(**state["totals"])
        self._controller.theta = arrays["theta"]
        self._good = self._good.with_theta(arrays["good"])
        self._plant.restore(self._plant.deserialise(arrays["plant"].tobytes()))
        self._algorithm.restore(_group(arrays, "algorithm"))
        self._interaction.resume(state["interaction"], _group(arrays, "interaction"))

    def write(self, parameters: Parameters) -> None:
        """Write learning.csv and parameters.toml."""
        assert self._out is not None
        write_atomically(self._out / "learning.csv", to_csv(self._rows))
        parameters.save(self._out / "parameters.toml")


def _group(arrays: dict[str, NDArray[Any]], prefix: str) -> dict[str, NDArray[Any]]:
    start = f"{prefix} "
    return {
        name.removeprefix(start): values
        for name, values in arrays.items()
        if name.startswith(start)
    }
