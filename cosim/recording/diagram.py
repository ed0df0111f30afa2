"""The signal-flow diagram: which box feeds which, and through what signals."""

from __future__ import annotations

import rerun as rr

from cosim.recording.glyphs import drawable
from cosim.recording.palette import FRAME, SERIES, packed_all
from cosim.recording.stream import Stream
from cosim.scenario import Scenario

ENTITY = "signal_flow"


def draw(stream: Stream, scenario: Scenario, controller: str, theta: str | None) -> None:
    """Log the diagram: boxes are programs, grey words the signals between them."""
    plant = f"plant: {scenario.plant.fmu.rsplit('/', 1)[-1]} (FMU)"
    law = scenario.disturbance.law
    policy = f"controller: {controller}" + (f"\nθ {theta}" if theta else "")
    explore = "none" if scenario.exploration is None else scenario.exploration.kind
    boxes = {
        "noise": (f"disturbance: {law}", (-250.0, 0.0), SERIES[4]),
        "plant": (plant, (0.0, 0.0), SERIES[0]),
        "controller": (policy, (0.0, 170.0), SERIES[2]),
        "exploration": (f"exploration: {explore}, if on", (-250.0, 170.0), SERIES[3]),
        "cost": ("stage cost + penalty", (250.0, 0.0), SERIES[1]),
        "recorder": ("recorder, learner", (250.0, 170.0), FRAME),
    }
    signals = {
        "d": ("d = " + ", ".join(scenario.plant.disturbances), "noise", "plant", (-125.0, -50.0)),
        "s": ("s = " + ", ".join(scenario.plant.states), "plant", "controller", (50.0, 85.0)),
        "pi": ("π(s)", "controller", "exploration", (-125.0, 210.0)),
        "a": ("a = " + ", ".join(scenario.plant.actions), "exploration", "plant", (-140.0, 85.0)),
        "l": (scenario.plant.stage_cost, "plant", "cost", (125.0, -50.0)),
        "L": ("L(s, a)", "cost", "recorder", (250.0, 85.0)),
        "V": ("V, gradients, status", "controller", "recorder", (125.0, 215.0)),
    }
    labels = [*(label for label, _, _ in boxes.values()), *(row[0] for row in signals.values())]
    colors = [*(color for _, _, color in boxes.values()), *[FRAME] * len(signals)]
    edges = [
        edge
        for name, (_, source, target, _) in signals.items()
        for edge in ((source, name), (name, target))
    ]
    stream.static(
        ENTITY,
        rr.GraphNodes(
            [*boxes, *signals],
            labels=[drawable(label) for label in labels],
            positions=[*(row[1] for row in boxes.values()), *(row[3] for row in signals.values())],
            colors=packed_all(colors),
            show_labels=True,
        ),
        rr.GraphEdges(edges, graph_type="directed"),
    )
