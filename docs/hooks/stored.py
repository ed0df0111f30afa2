"""The reports of the stored studies as pages of the site, with their figures."""

from __future__ import annotations

from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

RESULTS = Path(__file__).parents[2] / "results"
REPORTS = sorted(RESULTS.glob("*/report.md"))


def on_config(config: MkDocsConfig) -> None:
    """List the reports below the benchmark's pages."""
    pages = [{path.parent.name: f"results/{path.parent.name}/report.md"} for path in REPORTS]
    for entry in config.nav or []:
        entry.get("Benchmark", []).append({"Stored studies": pages})


def on_files(files: Files, config: MkDocsConfig) -> None:
    """Add each report and what its folder `figures` holds, under their paths in the repository."""
    for report in REPORTS:
        for path in (report, *sorted((report.parent / "figures").glob("*.svg"))):
            name = path.relative_to(RESULTS.parent).as_posix()
            files.append(File.generated(config, name, abs_src_path=str(path)))


def on_page_markdown(markdown: str, **_: object) -> str:
    """Links to stored studies: their folder lies beside docs/, and inside of the site."""
    return markdown.replace("](../results/", "](results/")
