import matplotlib as mpl
import pytest

from cosim.errors import FigureError
from cosim.figures import save
from cosim.figures.style import colors, figure, label


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


def test_another_format_is_refused(tmp_path):
    with pytest.raises(FigureError, match=r"must end in \.png or \.svg"):
        save(drawing(), tmp_path / "a.pdf")


def test_an_unwritable_folder_is_named(tmp_path):
    with pytest.raises(FigureError, match=r"cannot write .*no/a\.png"):
        save(drawing(), tmp_path / "no" / "a.png")


def test_names_become_mathematics_with_units():
    assert label("X2", "%") == "$X_{2}$ [%]"
    assert label("T200", "degC") == "$T_{200}$ [°C]"
    assert label("stage_cost", "1") == "stage cost"
    assert label("tank[1].level", "m") == "tank[1].level [m]"
    assert label("price_$", "$") == r"price \$ [\$]"


def test_controllers_have_colours_of_their_own():
    chosen = colors(["naive", "mine", "optimal", "yours", "tuned"])
    assert len(set(chosen.values())) == 5
    assert colors(["tuned"])["tuned"] == chosen["tuned"]


def test_colours_differ_and_that_of_an_absent_controller_goes_last():
    names = ["naive", "tuned", "learned", "mpcrl", "sac", "ppo", "optimal"]
    assert len(set(colors(names).values())) == 7
    assert colors(["converged"])["converged"] not in colors(names[:-2]).values()
