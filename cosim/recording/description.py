"""The text panel of a recording: what the run is and how to read the views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import isfinite

from cosim.recording.channels import Channel
from cosim.recording.glyphs import drawable
from cosim.scenario import Scenario


def describe(
    scenario: Scenario, properties: Mapping[str, object], channels: Sequence[Channel]
) -> str:
    """Markdown of one page: properties of the run, table of signals, reading guide."""
    facts = "\n".join(f"| {key.replace('_', ' ')} | {value} |" for key, value in properties.items())
    signals = "\n".join(
        f"| {c.name} | {c.unit or '–'} | {_bounds(c)} |"
        for c in channels
        if c.group in ("states", "actions", "disturbances", "costs")
    )
    page = f"""# {scenario.name}

{scenario.description}

| run | |
|---|---|
{facts}

| signal | unit | bounds |
|---|---|---|
{signals}

**Time** is the plant's; sample k of a state is the one that the controller measured, and the
input, disturbance and cost of sample k hold until sample k+1. The cost per sample is
*economic cost + penalty*; the penalty is {_weights(scenario)} of the violation v of the state
bounds (red lines).

**Prediction at the cursor** is the QP's solution at that sample: states over N stages, inputs held
over each stage, bounds in red, the reference in grey.
"""
    return drawable(page)


def _bounds(channel: Channel) -> str:
    lower, upper = channel.bounds
    if not isfinite(lower) and not isfinite(upper):
        return "–"
    return f"{lower:g} … {upper:g}"


def _weights(scenario: Scenario) -> str:
    linear, quadratic = scenario.penalty.linear, scenario.penalty.quadratic
    if len({*zip(linear, quadratic, strict=True)}) == 1:
        return f"{linear[0]:g}·v + {quadratic[0]:g}·v²"
    terms = zip(scenario.plant.states, linear, quadratic, strict=True)
    return ", ".join(f"{b:g}·v + {q:g}·v² ({name})" for name, b, q in terms)
