"""`cosim scenario`: show a scenario as it is after validation."""

from __future__ import annotations

from typing import Annotated

import typer

from cosim.cli.options import JsonOption
from cosim.cli.output import output


def scenario(
    name: Annotated[
        str | None, typer.Argument(help="Preset or TOML file; none lists the presets.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """List the presets, or print a scenario with every field written out, as TOML."""
    with output(json) as out_:
        from cosim.scenario import Scenario
        from cosim.scenario.loading import presets

        if name is None:
            loaded = [Scenario.load(preset) for preset in presets()]
            rows = [(item.name, item.hash, item.description) for item in loaded]
            out_.table("presets", ("name", "hash", "description"), rows)
            out_.json({"presets": {item.name: item.hash for item in loaded}})
            return
        chosen = Scenario.load(name)
        if json:
            out_.json(chosen.to_dict() | {"hash": chosen.hash})
        else:
            print(f"# hash {chosen.hash}\n{chosen.to_toml()}", end="")
