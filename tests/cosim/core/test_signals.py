"""Signals: the right value at the right sample, to the plant, to the judge and to controllers."""

import math

import numpy as np
import pytest

from controllers.factories import tuned
from cosim import FmuPlant, Scenario, simulate
from cosim.core.errors import PlantError, ScenarioError
from cosim.core.protocols import Decision, Step
from cosim.core.signals import Signals

PRICE = {"name": "price", "price_of": "F100", "included": 600.0}
BOUND = {"name": "least", "bound": "x_l[X2]"}


def with_signals(*tables, **changes):
    """`paper` with signals."""
    return Scenario.load("paper").replace({"signal": list(tables), **changes})


class Steady:
    """Holds the reference action, and keeps what it is told."""

    def __init__(self, scenario):
        self._action = scenario.reference_action
        self.told = []

    def reset(self):
        self.told.clear()

    def inform(self, known):
        self.told.append({name: values.tolist() for name, values in known.items()})

    def prepare(self):
        pass

    def feedback(self, s, a=None):
        return Decision(self._action)


def run(scenario, samples=24):
    """A run of the reference action, and what the controller was told."""
    controller = Steady(scenario)
    with FmuPlant(scenario) as plant:
        return simulate(plant, controller, samples, 3), controller.told


@pytest.mark.parametrize("h", [60.0, 0.1, 7.0])
def test_values_hold_until_the_next_one_and_come_again(h):
    table = BOUND | {"values": [25.0, 26.0, 27.0], "period": 6 * h}
    signals = Signals(with_signals(table, sampling_time=h))
    expected = [25.0, 25.0, 26.0, 26.0, 27.0, 27.0]
    values = signals.along(np.arange(60_000))[:, 0]
    assert np.array_equal(values, np.tile(expected, 10_000))


@pytest.mark.parametrize(
    ("period", "expected"),
    [
        # A period of 2.5 samples: the second value begins at 75 s, the period anew at 150 s.
        (150.0, [1.0, 1.0, 2.0, 1.0, 2.0]),
        # And of 7/3 samples, 140 s: 0, 60, 120, 40, 100, 20, 80 s in it, the second from 70 s on.
        (140.0, [1.0, 1.0, 2.0, 1.0, 2.0, 1.0, 2.0]),
    ],
)
def test_a_sample_has_the_value_at_its_begin_where_the_period_is_no_number_of_samples(
    period, expected
):
    table = PRICE | {"values": [1.0, 2.0], "period": period}
    signals = Signals(with_signals(table))
    values = signals.along(np.arange(100 * len(expected)))[:, 0]
    assert np.array_equal(values, np.tile(expected, 100))


def test_a_later_time_gives_later_values():
    table = PRICE | {"values": [1.0, 2.0, 5.0], "times": [0.0, 120.0, 180.0], "period": 600.0}
    model = {"controller": {"model": "controllers.evaporator:priced_model"}}
    known = {"model": "steam_price", "known": "preview", "ahead": 4}
    signals = Signals(with_signals(table | known, **model))
    for k in range(25):
        coming = signals.known(k)["price"]
        assert coming.tolist() == [signals.value(0, k + j) for j in range(5)]
        assert signals.value(0, k + 10) == signals.value(0, k)
    assert signals.along(np.arange(5))[:, 0].tolist() == [1.0, 1.0, 2.0, 5.0, 5.0]


def test_a_controller_is_told_what_is_known_at_the_sample_and_no_more():
    bound = {"values": [25.0, 26.0, 27.0, 28.0], "period": 240.0}
    tables = [
        BOUND | bound | {"known": "preview", "ahead": 2},
        {
            "name": "now",
            "values": [60.0, 70.0],
            "period": 120.0,
            "bound": "x_u[P2]",
            "known": "now",
        },
        {"name": "hidden", "plant": "T200_nominal", "values": [25.0], "period": 60.0},
    ]
    _, told = run(with_signals(*tables), 4)
    assert told == [
        {"least": [25.0, 26.0, 27.0], "now": [60.0]},
        {"least": [26.0, 27.0, 28.0], "now": [70.0]},
        {"least": [27.0, 28.0, 25.0], "now": [60.0]},
        {"least": [28.0, 25.0, 26.0], "now": [70.0]},
    ]


@pytest.mark.parametrize(
    ("table", "changes"),
    [
        ({"plant": "UA2"}, {"plant": {"parameters": {"UA2": 6.2}}}),
        ({"plant": "T200_nominal"}, {"disturbance": {"nominal": [5.0, 10.0, 40.0, 6.2]}}),
    ],
)
def test_a_signal_that_is_constant_is_the_scenario_with_that_value(table, changes):
    constant, _ = run(with_signals({"name": "c", "values": [6.2], "period": 60.0} | table))
    still, _ = run(Scenario.load("paper").replace(changes))
    assert np.array_equal(constant.states, still.states)
    assert np.array_equal(constant["stage_cost"], still["stage_cost"])


def test_a_signal_of_the_plant_acts_from_its_sample_on():
    step = {"name": "c", "plant": "UA2", "values": [6.84, 5.0], "once": 1440.0}
    moved, _ = run(with_signals(step))
    changed = {"time": 720.0, "parameters": {"UA2": 5.0}}
    change, _ = run(Scenario.load("paper").replace({"plant": {"changes": [changed]}}))
    assert np.array_equal(moved.states, change.states)


def test_a_price_is_in_the_cost_of_the_truth_alone():
    values = [600.0, 800.0, 500.0]
    priced, _ = run(with_signals(PRICE | {"values": values, "period": 180.0}))
    still, _ = run(Scenario.load("paper"))
    assert np.array_equal(priced.states, still.states)
    # F100 of the model's equations, by the FMU's own disturbances.
    F1, P100 = priced["F1"], priced["P100"]
    T2 = 0.5616 * priced["P2"] + 0.3126 * priced["X2"] + 48.43
    F100 = 0.16 * (F1 + 50.0) * (0.1538 * P100 + 90.0 - T2) / 36.6
    extra = (np.tile(values, 8) - 600.0) * F100
    assert priced["stage_cost"] - still["stage_cost"] == pytest.approx(extra, abs=1e-9)


def test_a_bound_that_moves_is_in_the_penalty_of_the_truth():
    values = [25.0, 30.0]
    scenario = with_signals(BOUND | {"values": values, "period": 240.0})
    moved, _ = run(scenario)
    bound = np.tile(np.repeat(values, 2), 6)
    assert moved["signal[least]"].tolist() == bound.tolist()
    violation = np.maximum(bound - moved["X2"], 0.0)
    assert moved["violation"] == pytest.approx(violation, abs=1e-12)
    assert moved["penalty"] == pytest.approx(1e5 * violation + violation**2, rel=1e-12)
    # The plant's own penalty is the same: a user's loop gets it.
    with FmuPlant(scenario) as plant:
        plant.reset(3)
        steps = [plant.step(scenario.reference_action) for _ in range(6)]
        snapshot = plant.snapshot()
        later = plant.step(scenario.reference_action)
        plant.restore(snapshot)
        assert plant.step(scenario.reference_action).penalty == later.penalty
    assert all(step.penalty >= 0.0 for step in steps)
    assert any(step.penalty > 1e5 for step in steps[2:4])


def test_a_nominal_signal_leaves_a_run_as_it_is():
    signal = BOUND | {"values": [25.0], "period": 60.0, "known": "preview"}
    runs = []
    for scenario in (Scenario.load("paper"), with_signals(signal)):
        with FmuPlant(scenario) as plant:
            runs.append(simulate(plant, tuned(scenario), 60, 1))
    for name in ("X2", "P2", "P100", "F200", "stage_cost", "penalty", "value"):
        assert np.array_equal(runs[0][name], runs[1][name]), name


def test_a_scenario_with_a_file_holds_its_values(tmp_path):
    (tmp_path / "p.csv").write_text("time [s],price [1/kg]\n0,500\n600,700\n")
    text = (
        'extends = "paper"\nschema = 1\nname = "filed"\n[[signal]]\nname = "price"\n'
        'file = "p.csv"\nperiod = 3600\nprice_of = "F100"\nincluded = 600\n'
    )
    path = tmp_path / "s.toml"
    path.write_text(text)
    scenario = Scenario.load(path)
    assert scenario.signals[0].values == (500.0, 700.0)
    assert scenario.signals[0].times == (0.0, 600.0)
    assert Scenario.from_dict(scenario.to_dict()).hash == scenario.hash
    (tmp_path / "p.csv").write_text("time [s],price [1/kg]\n0,500\n600,701\n")
    assert Scenario.load(path).hash != scenario.hash


FORECAST = {"name": "feed", "measures": "X1", "error": 0.5, "model": "X1", "known": "preview"}


def test_a_forecast_begins_with_what_is_realised_and_its_error_grows():
    scenario = with_signals(FORECAST | {"ahead": 9})
    realised, told = run(scenario, 1500)
    known = np.array([each["feed"] for each in told])
    assert np.array_equal(known[:, 0], realised["X1"])
    still, _ = run(Scenario.load("paper"), 1500)
    assert np.array_equal(realised.states, still.states)
    coming = np.lib.stride_tricks.sliding_window_view(realised["X1"], 10)
    errors = known[: len(coming), 1:] - coming[:, 1:]
    expected = 0.5 * np.sqrt(np.arange(1, 10))
    # Four standard errors of a standard deviation of so many draws.
    assert errors.std(axis=0) == pytest.approx(expected, rel=4 / math.sqrt(2 * len(coming)))
    _, again = run(scenario, 1500)
    assert again == told
    _, exact = run(with_signals(FORECAST | {"ahead": 9, "error": 0.0}), 40)
    assert np.array_equal([each["feed"] for each in exact[:31]], coming[:31])


def test_a_disturbance_that_follows_the_actions_cannot_be_forecast():
    scenario = with_signals(FORECAST)

    class Following:
        """A plant whose disturbances are its actions."""

        def reset(self, seed):
            return scenario.initial_state

        def step(self, a):
            return Step(scenario.initial_state, 0.0, 0.0, np.resize(a, 4))

    signals = Signals(scenario)
    signals.foresee(Following(), 1, 20)
    signals.check_foreseen(np.tile(np.resize(scenario.reference_action, 4), (20, 1)))
    with pytest.raises(PlantError, match="cannot be forecast"):
        signals.check_foreseen(np.ones((20, 4)))


BAD = [
    (BOUND | {"values": [25.0], "periodd": 60.0}, "unknown field .did you mean 'period'"),
    (FORECAST | {"measures": "X7"}, "none of plant.disturbances"),
    (FORECAST | {"known": "none"}, "needs model, and known"),
    (FORECAST | {"values": [5.0], "period": 60.0}, "can have no values"),
    (BOUND | {"values": []}, "give values or a file"),
    (BOUND | {"values": [25.0]}, "give period"),
    (BOUND | {"values": [25.0], "period": 60.0, "once": 60.0}, "give period"),
    (BOUND | {"values": [math.nan], "period": 60.0}, "values"),
    (BOUND | {"values": [25.0, 81.0, 101.0], "period": 180.0}, "comes up to 101"),
    (BOUND | {"values": [25.0], "period": 60.0, "bound": "x_l[X3]"}, "x_l\\[X3\\]' is of no state"),
    (BOUND | {"values": [25.0], "period": 60.0, "bound": "X2"}, "bound"),
    (BOUND | {"values": [25.0], "period": 60.0, "model": "T200"}, "one of model, bound"),
    (BOUND | {"values": [1.0, 2.0], "times": [0.0, 90.0], "period": 60.0}, "times must increase"),
    (BOUND | {"values": [1.0, 2.0], "times": [0.0], "period": 60.0}, "one for each value"),
    (BOUND | {"values": [25.0], "period": 60.0, "ahead": 2}, "needs known = 'preview'"),
    ({"name": "a", "values": [1.0], "period": 60.0}, "it moves nothing"),
    ({"name": "a", "values": [1.0], "period": 60.0, "plant": "P100"}, "is an action"),
    (BOUND | {"values": [25.0], "period": 45.0}, "a value lasts 45 s, less than the sampling time"),
    (BOUND | {"values": [25.0, 26.0], "period": 90.0}, "a value lasts 45 s"),
    (
        BOUND | {"values": [25.0, 26.0, 27.0], "times": [0.0, 120.0, 150.0], "once": 600.0},
        "a value lasts 30 s",
    ),
    ({"name": "a", "values": [1.0], "period": 60.0, "plant": "UA2", "known": "now"}, "needs model"),
    ({"name": "a", "values": [1.0], "period": 60.0, "reference": "X9"}, "no state or action"),
    ({"name": "a", "file": "/nowhere.csv", "period": 60.0, "plant": "UA2"}, "cannot be read"),
]


@pytest.mark.parametrize(("table", "message"), BAD)
def test_a_signal_that_does_not_fit_is_one_line(table, message):
    with pytest.raises(ScenarioError, match=message) as caught:
        with_signals(table)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        ("a\n1\nnan\n", "line 3: a is no finite number but 'nan'"),
        ("a\n1\n\nnan\n", "line 4: a is no finite number"),
        ("a\n1\n\n", None),
        ("a,a\n1,2\n", "has several columns 'a'"),
        ("a,time,time [s]\n1,0,0\n", "has several columns 'time'"),
        ("a,time\n1,0\n2,\n", "line 3: time is no finite number"),
        ("b\n1\n", "no column 'a'; it has b"),
        ("", "no column 'a'; it has nothing"),
    ],
)
def test_a_file_that_is_no_signal_is_refused_with_its_line(tmp_path, cells, message):
    path = tmp_path / "a.csv"
    path.write_text(cells)
    table = {"name": "a", "file": str(path), "period": 60.0, "plant": "UA2"}
    if message is None:
        assert with_signals(table).signals[0].values == (1.0,)
        return
    with pytest.raises(ScenarioError, match=message):
        with_signals(table)


def test_what_ends_before_the_run_is_refused_before_the_first_sample():
    short = with_signals(BOUND | {"values": [25.0, 26.0], "once": 1440.0})
    run(short, 24)
    with pytest.raises(
        ScenarioError, match=r"'least' ends after 1440 s, .* 25 samples needs 1500 s"
    ):
        run(short, 25)
    preview = with_signals(
        BOUND | {"values": [25.0, 26.0], "once": 1440.0, "known": "preview", "ahead": 3}
    )
    run(preview, 21)
    with pytest.raises(ScenarioError, match="22 samples with a preview of 3 needs 1500 s"):
        run(preview, 22)
    with FmuPlant(short) as plant:
        plant.reset(0)
        for _ in range(24):
            plant.step(short.reference_action)
        with pytest.raises(ScenarioError, match="has ended before sample 24"):
            plant.step(short.reference_action)


def test_an_unknown_variable_of_the_fmu_is_named():
    for field in ("plant", "price_of"):
        table = {"name": "a", "values": [1.0], "period": 60.0, field: "UA3"}
        with pytest.raises(PlantError, match=r"no variable 'UA3'.*did you mean 'UA"):
            FmuPlant(with_signals(table))
    with pytest.raises(PlantError, match="is an output, not an input"):
        FmuPlant(with_signals({"name": "a", "values": [1.0], "period": 60.0, "plant": "F2"}))
