"""`cosim scenario`: show a scenario as it is after validation, or draft one for an FMU."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from json import dumps
from pathlib import Path
from typing import Annotated

import typer
from typer.core import TyperGroup

import cosim
from cosim.cli import output as cli
from cosim.core.errors import CosimError
from cosim.core.files import write_atomically

OVER_PRICE = 100
"""Drafted penalty of a bound over its price."""


class ShowByDefault(TyperGroup):
    """`cosim scenario NAME` is `cosim scenario show NAME`."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        """Put `show` first where no command is named.

        Args:
            ctx: Click's context.
            args: words after `cosim scenario`.
        """
        known = {*self.commands, *ctx.help_option_names}
        if not args or args[0] not in known:
            args = ["show", *args]
        return super().parse_args(ctx, args)


scenario_app = typer.Typer(
    cls=ShowByDefault, help="Show scenarios (cosim scenario NAME), or draft one for an FMU."
)


@scenario_app.command("show")
def show_scenario(
    name: Annotated[str | None, typer.Argument()] = None,
    seed: Annotated[int | None, typer.Option("--seed-values", min=0)] = None,
    json: cli.JsonOption = False,
) -> None:
    """List the presets, or print a scenario with every field written out, as TOML.

    Args:
        name: Preset, random-SEED, random-coloured-SEED or TOML file; none lists the presets.
        seed: Print the start values of the plant's FMU (FMI 2.0) for a run of this seed.
    """
    with cli.output(json) as out_:
        from cosim.core.scenario import presets

        if name is None:
            rows = []
            hashes = {}
            for preset in presets():
                loaded = cosim.Scenario.load(preset)
                rows.append((loaded.name, loaded.hash, loaded.description))
                hashes[loaded.name] = loaded.hash
            out_.table("presets", ("name", "hash", "description"), rows)
            out_.json({"presets": hashes})
            return
        chosen = cosim.Scenario.load(name)
        if seed is not None:
            values = _seed_values(chosen, seed)
            lines = []
            for key, value in values.items():
                # As JSON, so that a Boolean is `true` as in the FMU, not `True`.
                lines.append(f"{key} = {dumps(value)}")
            out_.note("\n".join(lines))
            out_.json({"hash": chosen.hash, "seed": seed, "start_values": values})
            return
        if json:
            out_.json(chosen.to_dict() | {"hash": chosen.hash})
        else:
            # The hash is a comment: what is printed is a scenario file.
            print(f"# hash {chosen.hash}")
            print(chosen.to_toml(), end="")


def _seed_values(scenario: cosim.Scenario, seed: int) -> dict[str, float | bool | int]:
    """Start values of the plant's FMU for a run of this seed, by name, in their own types."""
    from cosim.core.simulation import spawn_seeds
    from cosim.plant.wiring import REALS, start_values

    plant_seed, _ = spawn_seeds(seed)
    values: dict[str, float | bool | int] = {}
    for name, (kind, value) in start_values(scenario, plant_seed).items():
        if kind in REALS:
            values[name] = float(value)
        elif kind == "Boolean":
            values[name] = bool(value)
        else:
            values[name] = int(value)
    return values


@scenario_app.command("init")
def draft(
    fmu: str,
    out: Annotated[Path | None, typer.Option("--out", "-o")] = None,
    states: str = "",
    actions: str = "",
    cost: str | None = None,
    model: Annotated[str | None, typer.Option("--model", "-m")] = None,
    sampling_time: Annotated[float | None, typer.Option(min=1e-9, max=1e12)] = None,
    state: str = "",
    action: str = "",
    overwrite: Annotated[bool, typer.Option("--overwrite")] = False,
    json: cli.JsonOption = False,
) -> None:
    """Draft a scenario for an FMU: a commented TOML file for you to correct.

    States, actions, cost, noise, ranges and start parameters are guessed from modelDescription.xml.
    The steady state near the start values is found by stepping the FMU, which runs its native code.

    Args:
        fmu: FMU: a path, or evaporator.
        out: File; default: the FMU's name, .toml.
        states: Names, comma-separated.
        actions: Names, comma-separated.
        cost: Output that is the stage cost.
        model: The controller's model, module:factory; penalties then follow from the prices of
            bounds.
        sampling_time: Sampling time in s.
        state: State near the steady state: numbers, comma-separated.
        action: Action near the steady state: numbers, comma-separated.
        overwrite: Replace the file if it is there.
    """
    with cli.output(json) as out_:
        from cosim.plant.draft import NO_NOISE, draft_scenario

        by_default = Path(f"{Path(fmu).stem}.toml")
        # Absolute, since an FMU may change the working directory.
        target = (out or by_default).absolute()
        if target.exists() and not overwrite:
            raise CosimError(
                f"'{target}' is there already; replace it by --overwrite, or use --out"
            )
        out_.announce(fmu)
        text = draft_scenario(
            fmu,
            target,
            states=cli.split_names(states),
            actions=cli.split_names(actions),
            stage_cost=cost,
            sampling_time=sampling_time,
            state=_numbers(state, "--state"),
            action=_numbers(action, "--action"),
            model=model,
        )
        # Whether the model is accurate is known only of a scenario that is valid.
        drafted = _parsed_scenario(text, target)
        if drafted.controller.model is not None:
            text = _with_enough_substeps(text, drafted)
            text = _with_priced_penalty(text, drafted)
        write_atomically(target, text)
        # As any later command reads it.
        drafted = cosim.Scenario.load(target)
        # The text ends its last line itself.
        if not json:
            print(text, end="")
        if drafted.disturbance.law == "none":
            out_.note(NO_NOISE)
        out_.note(f"written to {target}: read the lines with CHECK")
        out_.json({"file": str(target), **drafted.to_dict(), "hash": drafted.hash})


def _parsed_scenario(text: str, target: Path) -> cosim.Scenario:
    """The scenario of a file that is not written yet."""
    from tomllib import loads

    from cosim.core.scenario import resolved

    where = f"the draft of '{target}'"
    # Its paths are relative to the folder in which it will lie.
    document = resolved(loads(text), where, target.parent)
    return cosim.Scenario.from_dict(document, where)


def _with_enough_substeps(text: str, scenario: cosim.Scenario) -> str:
    """The draft, with more substeps where the model is integrated too coarsely at its bounds."""
    from controllers.preparation import integration_of
    from controllers.problem import Problem

    problem = Problem.from_scenario(scenario)
    integration = integration_of(problem)
    substeps = integration.suffices
    # Of a model that no number of steps makes accurate the default stays.
    if not integration.coarse or substeps is None:
        return text
    heading = "[controller]\n"
    line = f"substeps = {substeps} # so that the model is accurate at the bounds\n"
    return text.replace(heading, heading + line, 1)


def _with_priced_penalty(text: str, scenario: cosim.Scenario) -> str:
    """The draft, with penalties of a hundred times the prices of the model's active bounds.

    A violation of a bound that is not active costs as much as that of the dearest one, by the same
    share of its range. It then pays to violate a bound in about a hundredth of the samples. Where
    no bound of a state is active the draft's penalties stay.
    """
    from math import isfinite

    import numpy as np

    from controllers.economic import optimal_steady_state
    from controllers.errors import TuningError
    from controllers.problem import Problem

    # A penalty below a bound's price would not keep it, and the price would not show.
    n = len(scenario.plant.states)
    document = scenario.to_dict()
    document["penalty"]["linear"] = [1e12] * n
    problem = Problem.from_scenario(cosim.Scenario.from_dict(document))
    try:
        steady = optimal_steady_state(problem)
    except TuningError:
        return text
    is_active = steady.C[:, :n].any(axis=0)
    prices = np.where(is_active, np.abs(steady.multipliers[:n]), 0.0)
    spans = problem.state_upper - problem.state_lower
    spans = np.where(np.isfinite(spans), spans, 1.0)
    dearest = float((prices * spans).max())
    if not (dearest > 0 and isfinite(dearest)):
        return text
    exact = OVER_PRICE * np.maximum(prices, dearest / spans)
    weights = [float(f"{weight:.1g}") for weight in exact.tolist()]
    before = f"linear = {_toml_list(scenario.penalty.linear)}"
    after = f"linear = {_toml_list(weights)}"
    remark = (
        f"{OVER_PRICE} times what bounds cost by the model ({'; '.join(steady.prices())}): one "
        f"that is active is then violated in about one sample in {OVER_PRICE} at best"
    )
    lines = textwrap.wrap(remark, 98, break_on_hyphens=False)
    commented = "".join(f"# {line}\n" for line in lines)
    return text.replace(before, commented + after, 1)


def _toml_list(values: Sequence[float]) -> str:
    """Numbers as `tomli_w` writes them in one key."""
    import tomli_w

    return tomli_w.dumps({"values": list(values)}).partition(" = ")[2].strip()


def _numbers(text: str, option: str) -> list[float]:
    words = cli.split_names(text)
    try:
        return [float(word) for word in words]
    except ValueError:
        raise CosimError(f"{option} takes numbers, comma-separated, not '{text}'") from None
