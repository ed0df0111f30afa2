"""Results in one line at a prompt and as a table with a picture in a notebook; tables as CSV."""

import numpy as np
import pytest

import cosim
from cosim.core.errors import CosimError
from cosim.core.result import text_table


@pytest.fixture(scope="module")
def run():
    scenario = cosim.Scenario.load("paper")
    with cosim.FmuPlant(scenario) as plant:
        return cosim.simulate(plant, cosim.build_controller("naive", scenario), 20, 0)


class Followed:
    """A tracker that keeps what it is told."""

    def __init__(self):
        self.told = []

    def start(self, run):
        self.told.append(run)

    def __call__(self, samples, row):
        self.told.append((samples, row["samples"]))

    def end(self, training):
        self.told.append(training)


@pytest.fixture(scope="module")
def followed():
    return Followed()


@pytest.fixture(scope="module")
def training(followed):
    sizes = {"log_every": 20, "evaluate_every": 40, "checkpoint_every": 40}
    sizes |= {"evaluation_seeds": 1, "evaluation_steps": 10, "progress": followed}
    return cosim.train("q-learning", samples=40, **sizes)


def test_a_tracker_is_told_of_the_start_each_row_and_the_end(training, followed):
    assert followed.told == [training.run, (20, 20), (40, 40), training]


@pytest.mark.slow
def test_every_result_is_a_line_a_table_and_a_page(run, training, tmp_path):
    scenario = cosim.Scenario.load("paper")
    evaluation = cosim.evaluate(scenario, ["naive"], 2, 10)
    for result in (run, training, evaluation, scenario, training.parameters):
        text = repr(result)
        assert text.startswith(f"{type(result).__name__}(") and text.endswith(")")
        assert "\n" not in text and len(text) < 300
        page = result._repr_html_()
        assert f"<caption>{type(result).__name__}</caption>" in page
        drawn = result not in (scenario, training.parameters)
        assert ('src="data:image/png;base64,' in page) == drawn
        if drawn:
            assert page in result.report(tmp_path / "page.html").read_text("utf-8")
            assert result.table().startswith("| ") and result.figure().axes


def test_frames_hold_the_values(run, training):
    frame = run.to_pandas()
    np.testing.assert_array_equal(frame["X2"], run["X2"])
    assert list(frame["status"]) == list(run.status)
    np.testing.assert_array_equal(training.to_pandas()["samples"], [0, 20, 40])
    np.testing.assert_array_equal(
        training.parameters.to_pandas()["theta"], training.parameters.theta
    )


def test_a_table_has_the_format_of_the_paper_that_it_goes_to():
    header = ("case", "regret %")
    rows = [("a_b & c", "1 [0, 2]"), ("[d]", "3\\4")]
    assert text_table(header, rows, "markdown").splitlines()[1] == "| --- | ---: |"
    latex = text_table(header, rows, "latex").splitlines()
    assert latex[0] == r"\begin{tabular}{lr}"
    assert latex[2:5] == [r"case & regret \% \\", r"\midrule", r"a\_b \& c & 1 [0, 2] \\"]
    assert latex[5] == r"{}[d] & 3\textbackslash{}4 \\"
    assert "<td>a_b &amp; c</td>" in text_table(header, rows, "html")
    with pytest.raises(CosimError, match=r"'latx' \(did you mean 'latex'"):
        text_table(header, rows, "latx")
