"""The page's table of the study that goes on while the plant drifts is the stored one."""

from cosim.study.online import tables
from cosim.study.results import StudyResults
from tests.helpers.code_blocks import ROOT

LABELS = {
    "hindsight": "in hindsight: both back-offs, held",
    "fouled": "commissioned on the fouled plant, held",
    "clean": "commissioned on the clean plant, held",
    "offset-free(start=fouled)": "offset-free, from the fouled plant's",
    "offset-free(start=clean)": "offset-free, from the clean plant's",
    "identified": "identified each day, from the clean plant's",
    "learnt-and-frozen(start=fouled)": "**learnt for a cycle, then held**, from the fouled plant's",
    "learnt-and-frozen(start=clean)": "**learnt for a cycle, then held**, from the clean plant's",
    "continual(start=fouled)": "**continual learning**, from the fouled plant's",
    "continual(start=clean)": "**continual learning**, from the clean plant's",
}
HEAD = """\
| θ | regret %, mean [95 %] | worst | cycle 1 | cycle 2 | cycle 3 | cycle 4 |
|---|---:|---:|---:|---:|---:|---:|"""


def drifting():
    """The table's lines, least regret first."""
    results = StudyResults.load(ROOT / "results" / "continual")
    ((_, _, rows),) = tables(results)
    lines = [HEAD]
    for case, runs, mean, _, worst, *cycles in rows:
        if case not in ("optimal", "naive"):
            assert runs == "10", case
            lines.append(f"| {' | '.join([LABELS[case], mean, worst, *cycles])} |")
    return "\n".join(lines)


def test_the_table_is_the_stored_one():
    page = (ROOT / "docs" / "benchmark.md").read_text("utf-8")
    assert drifting() in page, f"the table shall be\n{drifting()}"
