"""The reproduction in words and tables, as Markdown and for the terminal."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from cosim.evaluation.statistics import shown

Lines = list[list[str]]

PAPER = {"naive": 21.0, "tuned": 15.0}
"""Economic gain of the paper's RL-tuned RTI-NMPC over (a) and (b), in per cent."""

NEAR = 3.0
"""Per cent within which a gain is taken for the paper's, which it gives as approximate."""


def comparison_lines(summary: Mapping[str, Any]) -> Lines:
    """The paper's table, header first: gains over (a) and (b), and the distance to the optimum."""
    header = ["controller", "trainings", "J", "regret %", "violating %", "gain over (a) %"]
    lines = [[*header, "gain over (b) %", "gap closed %", "worst %"]]
    for row in summary["comparison"]:
        seeds = int(row["training_seeds"])
        lines.append(
            [
                row["controller"],
                str(seeds or ""),
                cell(row, "J", 1.0, 6),
                cell(row, "regret", 100.0, 3),
                number(row["violating_share"], 100.0),
                cell(row, "gain_over_naive", 100.0),
                cell(row, "gain_over_tuned", 100.0),
                cell(row, "gap_closed", 100.0),
                number(row["worst_gap_closed"], 100.0) if seeds else "",
            ]
        )
    return lines


def converged_lines(summary: Mapping[str, Any]) -> Lines:
    """RTI against converged NMPC, header first."""
    lines = [["θ", "J of RTI", "J converged − J RTI"]]
    for row in summary["converged"]:
        lines.append([row["rti"], cell(row, "J_rti", 1.0, 6), cell(row, "J_difference", 1.0, 3)])
    return lines


def timing_lines(summary: Mapping[str, Any]) -> Lines:
    """Median time per step of RTI and converged NMPC, header first; for the terminal only."""
    lines = [["θ", "µs RTI", "µs converged", "ratio"]]
    for row in summary["converged"]:
        rti, converged = (
            timing["prepare_median_us"] + timing["feedback_median_us"]
            for timing in (summary["timing"][row[kind]] for kind in ("rti", "converged"))
        )
        lines.append([row["rti"], f"{rti:.0f}", f"{converged:.0f}", f"{converged / rti:.1f}"])
    return lines


def map_lines(summary: Mapping[str, Any]) -> Lines:
    """Gains at each reading of the open points, header first; only learned and optimal rows.

    The paper's two gains imply J(b)/J(a) = (1 − 0.21)/(1 − 0.15) = 0.93, whatever was learnt.
    """
    header = ["sampling time s", "γ", "law", "b_σ", "J(b)/J(a)", "controller", "J"]
    lines = [[*header, "gain over (a) %", "gain over (b) %", "like the paper"]]
    costs: dict[str, float] = {}
    for row in summary["map"]:
        if row["controller"] in PAPER:
            costs[row["controller"]] = float(row["J"])
            continue
        lines.append(
            [
                *(row[name] for name in ("sampling_time", "discount", "law", "penalty_weight")),
                f"{costs['tuned'] / costs['naive']:.3f}",
                row["controller"],
                number(row["J"], 1.0, 1),
                number(row["gain_over_naive"], 100.0),
                number(row["gain_over_tuned"], 100.0),
                " and ".join(like_paper(row)),
            ]
        )
    return lines


def like_paper(row: Mapping[str, str]) -> list[str]:
    """Which of the paper's two gains a row of the map shows, within `NEAR`."""
    return [
        f"({letter})"
        for letter, (name, gain) in zip("ab", PAPER.items(), strict=True)
        if row[f"gain_over_{name}"] and abs(100 * float(row[f"gain_over_{name}"]) - gain) <= NEAR
    ]


TABLES: tuple[tuple[str, Callable[[Mapping[str, Any]], Lines]], ...] = (
    ("The paper's comparison: it gives about 21 % over (a) and 15 % over (b)", comparison_lines),
    ("RTI against converged NMPC with the same θ", converged_lines),
    ("Reproduction map: the gains at each reading of the paper's open points", map_lines),
)

HEAD = """\
# Reproduction of the paper's section Simulations, budget {budget}

Made by `cosim reproduce --budget {budget}`. J is the mean of economic cost + penalty per sample,
on noise that no training met. Intervals are of 95 % (Student's t), over noise seeds for one
controller and over training seeds for a learner. Regret = (J − J*)/|J*| and gap closed =
(J_naive − J)/(J_naive − J*), with J* the mean cost of the dynamic-programming optimum on the same
noise.
"""


def report(summary: Mapping[str, Any], figures: Sequence[str]) -> str:
    """The report as Markdown, without any reading of a clock."""
    parts = [HEAD.format(**summary)]
    for title, lines in TABLES:
        parts += [f"## {title}\n", markdown(lines(summary)), ""]
    parts.append(_verdict(summary))
    parts.append("## Parameter increments and TD error\n")
    parts += [f"![{figure}]({figure})" for figure in figures]
    parts.append("\n## Trainings\n\n```sh")
    for key, training in summary["trainings"].items():
        parts.append(f"{training['command']}  # {key}: {training['status']}")
    return "\n".join([*parts, "```", ""])


def _verdict(summary: Mapping[str, Any]) -> str:
    both = [row for row in summary["map"] if len(like_paper(row)) == 2]
    if not both:
        return (
            f"No reading shows both of the paper's gains within {NEAR:g} per cent; the map's last "
            "column names those that show one. The paper's gains imply J(b)/J(a) = 0.93.\n"
        )
    found = (
        f"{row['sampling_time']} s, γ {row['discount']}, {row['law']}, b_σ {row['penalty_weight']}"
        for row in both
    )
    return f"Both of the paper's gains, within {NEAR:g} per cent, appear at: {'; '.join(found)}.\n"


def markdown(lines: Lines) -> str:
    """Lines, header first, as a Markdown table."""
    header, *body = lines
    rule = ["---", *["---:"] * (len(header) - 1)]
    return "\n".join(f"| {' | '.join(line)} |" for line in (header, rule, *body))


def cell(row: Mapping[str, str], name: str, scale: float, digits: int = 4) -> str:
    """`value [low, high]` of a figure, `value` where it has no interval, else nothing."""
    if not row[name]:
        return ""
    low, high = row[f"{name}_low"], row[f"{name}_high"]
    return shown(float(row[name]), (float(low), float(high)) if low else None, scale, digits)


def number(text: str, scale: float, digits: int = 2) -> str:
    """A cell's number, scaled and rounded."""
    return f"{scale * float(text):.{digits}f}" if text else ""
