"""A study's report: one HTML page that needs nothing else, and the same tables as Markdown."""

from __future__ import annotations

import base64
import re
import shlex
from collections.abc import Sequence
from html import escape
from pathlib import Path

from cosim.files import write_atomically
from cosim.study.charts import FOLDER, draw
from cosim.study.formatting import (
    AGGREGATE_HEADER,
    HEADER,
    aggregate_lines,
    lines,
    run_lines,
    setting_lines,
)
from cosim.study.paper import further
from cosim.study.results import StudyResults
from cosim.text_tables import markdown_table

PAGE, TABLES = "report.html", "report.md"
CAPTIONS = {
    "parameters": "Increments of θ by block, and the TD error: root mean square over the updates "
    "of the preceding 10 000 samples (the paper's figure). First training seed.",
    "overlay": "All on the same disturbances; the area beyond a bound is shaded.",
    "phase": "Where the state lives (density) and what the policy does there (arrows).",
    "density": "Density of the first state against its lower bound.",
    "regret": "Regret of every run. Dots are training runs, crosses runs that diverged; the bar is "
    "the interquartile mean with its 95 % interval (bootstrap over runs; for a controller without "
    "training over the noise seeds).",
    "curves": "Learning: above what the training samples themselves cost, below the greedy policy "
    "on held-out noise. Medians over training seeds and their quartiles; a run that diverged is "
    "held where it ended. Dashed: baselines.",
    "online": "What the runs themselves cost, exploration included: regret against the optimum on "
    "the same noise, mean over training seeds; above, from the log of the first training seed.",
    "profile": "Performance profile: the share of runs whose regret is at most so much, with a "
    "95 % band (stratified bootstrap over runs).",
}
NOTES = (
    "Regret is (J − J*)/|J*|, J the mean of economic cost and penalty per sample, J* that of the "
    "dynamic-programming optimum on the same noise. Medians are of the middle runs, with an "
    "interval paired over the noise seeds; the interquartile mean (IQM) is over training seeds, "
    "with a stratified bootstrap interval. Runs that diverged count with the cost of the θ that "
    "they ended with. Plant samples are those of training and of choosing θ."
)


def write_report(results: StudyResults, folder: Path | None = None) -> Path:
    """Write report.html, report.md and figures/ into the study's folder; returns the page."""
    target = results.folder if folder is None else folder
    figures = draw(results, target)
    write_atomically(target / TABLES, report_markdown(results, figures))
    return write_atomically(target / PAGE, report_html(results, figures, target))


def report_markdown(results: StudyResults, figures: dict[str, list[str]]) -> str:
    """The report as Markdown, with links to the figures."""
    about = results.about
    parts = [f"# {about['title'] or results.name}\n"]
    if about["description"]:
        parts.append(f"{about['description']}\n")
    parts += [_progress(results), f"{NOTES}\n"]
    for scenario in results.scenarios:
        parts += [f"## Scenario `{scenario}`\n", _noise(results, scenario)]
        parts.append(markdown_table(HEADER, lines(results, scenario)))
        parts += [f"![{name}]({FOLDER}/{name}.svg)\n" for name in figures[scenario]]
    if overall := aggregate_lines(results):
        parts += ["## All scenarios\n", markdown_table(AGGREGATE_HEADER, overall)]
        parts += [f"![{name}]({FOLDER}/{name}.svg)\n" for name in figures[""]]
    for title, head, body in further(results):
        parts += [f"## {title}\n", markdown_table(head, body)]
    parts += [f"![{name}]({FOLDER}/{name}.svg)\n" for name in results.about["pictures"]]
    header, rows = setting_lines(results)
    parts += ["## Cases\n", markdown_table(header, rows), f"{_made(results)}\n"]
    return "\n".join(parts)


def _progress(results: StudyResults) -> str:
    missing = results.about["runs"] - len(results.runs)
    text = f"{len(results.runs)} of {results.about['runs']} runs are finished"
    return f"{text}; {missing} are missing here.\n" if missing else f"{text}.\n"


def _noise(results: StudyResults, scenario: str) -> str:
    run = next((run for run in results.runs if run.scenario == scenario), None)
    if run is None:
        return "No run is finished.\n"
    return f"Evaluated on {len(run.seeds)} noise seeds × {run.steps} samples.\n"


def _made(results: StudyResults) -> str:
    made = results.about["made_with"]
    return f"Made with {made['versions']}; code {made['code_hash']}."


def report_html(results: StudyResults, figures: dict[str, list[str]], folder: Path) -> str:
    """The report as one page: styles, figures and all within."""
    about = results.about
    title = escape(about["title"] or results.name)
    sections = [
        f"<h1>{title}</h1>",
        f"<p class='lead'>{escape(about['description'])}</p>" if about["description"] else "",
        f"<p>{_progress(results)}</p>",
        _navigation(results),
    ]
    for number, scenario in enumerate(results.scenarios):
        sections += [
            f"<section id='s{number}'><h2>Scenario {escape(scenario)}</h2>",
            f"<p>{_noise(results, scenario)}</p>",
            table(HEADER, lines(results, scenario)),
            *(_figure(folder, name) for name in figures[scenario]),
            "</section>",
        ]
    if overall := aggregate_lines(results):
        sections += ["<section id='all'><h2>All scenarios</h2>", table(AGGREGATE_HEADER, overall)]
        sections += [*(_figure(folder, name) for name in figures[""]), "</section>"]
    for title, head, body in further(results):
        sections += [f"<section><h2>{escape(title)}</h2>", table(head, body), "</section>"]
    if pictures := results.about["pictures"]:
        sections += ["<section id='samples'><h2>Sample by sample</h2>"]
        sections += [*(_figure(folder, name) for name in pictures), "</section>"]
    header, rows = setting_lines(results)
    sections += ["<section id='cases'><h2>Cases</h2>", table(header, rows), "</section>"]
    header, rows = run_lines(results)
    summary = f"<summary>Every run ({len(rows)})</summary>"
    sections += [f"<section id='runs'><h2>Runs</h2><details>{summary}", table(header, rows)]
    sections += ["</details></section>", f"<footer><p>{NOTES}</p><p>{escape(_made(results))}</p>"]
    command = shlex.join(["cosim", "study", "run", f"{results.name}.toml"])
    sections += [f"<p>Made by <code>{escape(command)}</code>.</p></footer>"]
    return _TEMPLATE.format(title=title, style=_STYLE, body="\n".join(sections), script=_SCRIPT)


def _navigation(results: StudyResults) -> str:
    links = [
        f"<a href='#s{number}'>{escape(scenario)}</a>"
        for number, scenario in enumerate(results.scenarios)
    ]
    links += ["<a href='#all'>all scenarios</a>"] if aggregate_lines(results) else []
    links += ["<a href='#cases'>cases</a>", "<a href='#runs'>runs</a>"]
    return f"<nav>{' '.join(links)}</nav>"


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table whose columns are sorted by a click on their heads."""
    head = "".join(f"<th scope='col'>{escape(name)}</th>" for name in header)
    body = "".join(
        "<tr>" + "".join(f"<td>{escape(text)}</td>" for text in row) + "</tr>" for row in rows
    )
    inner = f"<thead><tr>{head}</tr></thead><tbody>{body}</tbody>"
    return f"<div class='wide'><table>{inner}</table></div>"


def _figure(folder: Path, name: str) -> str:
    drawing = (folder / FOLDER / f"{name}.svg").read_bytes()
    data = base64.b64encode(drawing).decode()
    width = re.search(rb'width="([\d.]+)pt"', drawing)
    size = f" style='width:{1.7 * float(width[1]):.0f}px'" if width else ""
    caption = escape(CAPTIONS.get(name.partition("-")[0], name))
    image = f"<img{size} alt='{escape(name)}' src='data:image/svg+xml;base64,{data}'>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


_TEMPLATE = """\
<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
{body}
</main>
<script>{script}</script>
</body>
</html>
"""

_STYLE = """
:root { color-scheme: light; --ink: #1d2530; --soft: #5a6570; --line: #dfe4ea; --link: #0072b2; }
body { margin: 0; background: #fff; color: var(--ink);
  font: 15px/1.5 system-ui, -apple-system, "Segoe UI", "DejaVu Sans", sans-serif; }
main { max-width: 1320px; margin: 0 auto; padding: 24px 20px 60px; }
h1 { font-size: 1.7rem; margin: 0 0 .3rem; } h2 { font-size: 1.25rem; margin: 2.2rem 0 .4rem; }
.lead { font-size: 1.05rem; color: var(--soft); max-width: 70ch; margin-top: 0; }
nav { display: flex; flex-wrap: wrap; gap: 4px 16px; border-bottom: 1px solid var(--line);
  padding-bottom: 8px; } a { color: var(--link); }
.wide { overflow-x: auto; margin: 10px 0 18px; }
table { border-collapse: collapse; font-size: 12.5px; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 7px; text-align: right; white-space: nowrap;
  border-bottom: 1px solid var(--line); }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: #fff; }
th { cursor: pointer; color: var(--soft); font-weight: 600; vertical-align: bottom; }
th[aria-sort=ascending]::after { content: " \\25B2"; }
th[aria-sort=descending]::after { content: " \\25BC"; }
tbody tr:hover td { background: #f4f7fa; }
figure { margin: 18px 0 26px; } img { max-width: 100%; height: auto; }
figcaption, footer { color: var(--soft); font-size: 13px; max-width: 85ch; }
footer { margin-top: 3rem; border-top: 1px solid var(--line); }
"""

_SCRIPT = """
for (const head of document.querySelectorAll("th")) head.addEventListener("click", () => {
  const row = head.parentNode, column = [...row.children].indexOf(head);
  const body = head.closest("table").tBodies[0];
  const down = head.getAttribute("aria-sort") === "ascending";
  for (const other of row.children) other.removeAttribute("aria-sort");
  head.setAttribute("aria-sort", down ? "descending" : "ascending");
  const key = line => { const text = line.children[column].textContent;
    const number = parseFloat(text); return [isNaN(number), number, text]; };
  const lines = [...body.rows].map(line => [key(line), line]);
  lines.sort(([a], [b]) => a[0] - b[0] || (a[0] ? a[2].localeCompare(b[2]) : a[1] - b[1])
    * (down ? -1 : 1));
  for (const [, line] of lines) body.append(line);
});
"""
