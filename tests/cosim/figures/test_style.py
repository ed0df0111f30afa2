import matplotlib as mpl
import pytest

from cosim.figures import save
from cosim.figures.style import figure


def drawing():
    with figure(2.0) as drawn:
        axes = drawn.subplots()
        axes.plot([0.0, 1.0], [1.0, 0.0], label="$x_1$")
        axes.legend()
    return drawn


@pytest.mark.parametrize("kind", ["png", "svg"])
def test_the_same_figure_gives_the_same_bytes(tmp_path, kind):
    one, two = (save(drawing(), tmp_path / f"{i}.{kind}").read_bytes() for i in range(2))
    assert one == two
    assert b"Date" not in one
    assert b"date" not in one


def test_the_users_settings_neither_matter_nor_change(tmp_path):
    plain = save(drawing(), tmp_path / "a.svg").read_bytes()
    with mpl.rc_context({"lines.linewidth": 9.0, "font.size": 20.0, "svg.hashsalt": "other"}):
        before = dict(mpl.rcParams)
        styled = save(drawing(), tmp_path / "b.svg").read_bytes()
        assert dict(mpl.rcParams) == before
    assert styled == plain
