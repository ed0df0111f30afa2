"""What an FMU can do is found out, on FMUs with the habits of real ones (`foreign/habits.c`)."""

import fmpy
import numpy as np
import pytest

import fmus
from cosim import FmuPlant, Scenario, simulate
from cosim.core.errors import CapabilityError, PlantError
from cosim.plant.probe import OutputKind, Restart, probe
from tests.helpers.kinds import build_habits, habit_scenario
from tests.helpers.loop import Playback

LAGGED, EAGER, NO_RESET, SHY, NEEDS_STOP, PART, HOLDS, DEAF, RESTLESS, MIXED, SLEEPY, ENABLED = (
    2**i for i in range(12)
)
HALF_LOUD, FREE, OWN_STEP, STUCK, FRAIL = 4096, 8192, 16384, 32768, 65536
STEP, STEPS = 0.5, 8
ACTIONS = np.array([2.0, 0.5, 1.0, 3.0, 0.25, 1.5, 2.5, 0.75])


@pytest.fixture(scope="module", params=[2, 3], ids=["fmi2", "fmi3"])
def fmu(request, tmp_path_factory):
    experiment = '<DefaultExperiment startTime="0" stopTime="4"/>'
    return build_habits(tmp_path_factory.mktemp("habits"), request.param, experiment=experiment)


@pytest.fixture
def made(fmu, tmp_path):
    def scenario(habits=0, **plant):
        return habit_scenario(tmp_path, fmu, habits, **plant)

    return scenario


def driven(scenario):
    """States (K+1, 1), costs and disturbances of an episode under the actions."""
    with FmuPlant(scenario) as plant:
        rows = [plant.reset(0)]
        steps = [plant.step([u]) for u in ACTIONS]
    states = [s[0] for s in (*rows, *(step.s for step in steps))]
    costs = [step.stage_cost for step in steps]
    return np.array(states), np.array(costs), np.array([step.disturbance[0] for step in steps])


def by_fmpy(fmu, habits, start_time=0.0, **options):
    """x, cost and d before the first and after each step, by another importer."""
    times = start_time + STEP * np.arange(STEPS + 1)
    inputs = np.array(
        list(zip(times, [*ACTIONS, ACTIONS[-1]], strict=True)),
        dtype=[("time", float), ("u", float)],
    )
    # A step signal: fmpy would interpolate between the points.
    return fmpy.simulate_fmu(
        str(fmu),
        start_time=start_time,
        stop_time=times[-1],
        output_interval=STEP,
        start_values={"fault": habits, "x_start": 1.0},
        input=inputs,
        output=["x", "cost", "d"],
        **options,
    )


def exact_cost(states, actions):
    return (states - 2.0) ** 2 + actions**2


@pytest.mark.parametrize(
    "habits", [0, LAGGED, MIXED, LAGGED | SLEEPY, LAGGED | NO_RESET, LAGGED | SHY, MIXED | SHY]
)
def test_cost_and_disturbance_are_those_of_their_sample(made, habits):
    states, costs, disturbances = driven(made(habits))
    np.testing.assert_array_equal(costs, exact_cost(states[:-1], ACTIONS))
    np.testing.assert_array_equal(disturbances, np.sin(STEP * np.arange(STEPS)))


def test_an_output_of_the_state_alone_is_that_of_its_sample(made):
    for habits in (FREE, FREE | SLEEPY, FREE | SHY, FREE | LAGGED):
        states, costs, _ = driven(made(habits))
        np.testing.assert_array_equal(costs, (states[:-1] - 2.0) ** 2)


def test_a_cost_of_the_steps_end_is_that_and_bars_the_optimum(made):
    for habits in (EAGER, SHY):
        states, costs, _ = driven(made(habits))
        np.testing.assert_array_equal(costs, exact_cost(states[1:], ACTIONS))
        with pytest.raises(PlantError, match=r"end of a step only.*no J"):
            FmuPlant(made(habits, model="controllers.tanks:model"))


@pytest.mark.parametrize("habits", [0, LAGGED, EAGER, SHY, NO_RESET, HOLDS, MIXED, NEEDS_STOP])
def test_states_and_outputs_are_those_of_another_importer(made, fmu, habits):
    reference = by_fmpy(fmu, habits)
    states, costs, _ = driven(made(habits))
    np.testing.assert_array_equal(states, reference["x"])
    if habits in (LAGGED, EAGER, MIXED):
        np.testing.assert_array_equal(costs, reference["cost"][1:])


@pytest.mark.parametrize(
    ("habits", "stated", "words"),
    [
        (0, "after-step", r"output 'cost' follows the actions at once; set it to \"before-step\""),
        (LAGGED, "before-step", r"'cost' is computed by doStep .*; set it to \"after-step\""),
        (MIXED, "before-step", r"'cost' is computed by doStep .*; leave it out"),
        (SHY, "before-step", r"'cost' is computed by doStep .*; leave it out"),
    ],
)
def test_a_stated_order_that_was_seen_wrong_is_refused(made, habits, stated, words):
    with pytest.raises(PlantError, match=words):
        FmuPlant(made(habits, outputs=stated))


def test_a_stated_order_that_fits_changes_nothing(made):
    for habits, stated in ((0, "before-step"), (LAGGED, "after-step")):
        for one, other in zip(
            driven(made(habits)), driven(made(habits, outputs=stated)), strict=True
        ):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("habits", [0, NO_RESET, NO_RESET | LAGGED, RESTLESS])
def test_each_episode_begins_as_the_first(made, habits):
    with FmuPlant(made(habits)) as plant:
        runs = [simulate(plant, Playback(ACTIONS[:, None]), STEPS, seed) for seed in (0, 0)]
        assert plant.reset(0, [2.0]).tolist() == [2.0]
        assert plant.reset(0).tolist() == [1.0]
    same = np.array_equal(runs[0]["x"], runs[1]["x"])
    assert same == (habits != RESTLESS)


def test_a_second_episode_that_cannot_begin_is_refused(tmp_path):
    fmu = build_habits(tmp_path, once=True)
    with FmuPlant(habit_scenario(tmp_path, fmu)) as plant:
        assert [plant.reset(0).tolist() for _ in range(2)] == [[1.0], [1.0]]
    with FmuPlant(habit_scenario(tmp_path, fmu, NO_RESET)) as plant:
        plant.reset(0)
        with pytest.raises(CapabilityError, match="cannot begin a second episode"):
            plant.reset(0)


@pytest.mark.parametrize(
    ("habits", "words"),
    [(PART, "the same steps give other numbers"), (HOLDS, "while a state is saved")],
)
def test_a_snapshot_that_does_not_restore_is_refused(made, habits, words):
    with FmuPlant(made(habits)) as plant:
        plant.reset(0)
        with pytest.raises(CapabilityError, match=f"declares that it can save.*{words}"):
            plant.snapshot()


def test_a_snapshot_ends_with_its_episode_where_there_is_no_reset(made):
    with FmuPlant(made(NO_RESET)) as plant:
        plant.reset(0)
        snapshot = plant.snapshot()
        expected = plant.step([2.0]).s
        plant.restore(snapshot)
        assert plant.step([2.0]).s == expected
        plant.reset(0)
        with pytest.raises(PlantError, match="taken in an earlier episode"):
            plant.restore(snapshot)


def test_a_start_that_the_fmu_does_not_take_is_refused(made):
    with FmuPlant(made(DEAF)) as plant, pytest.raises(PlantError, match="to start at x = 1 and"):
        plant.reset(0)
    with pytest.raises(PlantError, match="was given key = 7 and has 3"):
        FmuPlant(made(parameters={"fault": HALF_LOUD, "key": 7.0}))


def test_the_time_of_the_fmu_begins_where_the_scenario_says(made, fmu):
    reference = by_fmpy(fmu, 0, start_time=100.0)
    scenario = made(start_time=100.0)
    states, _, disturbances = driven(scenario)
    np.testing.assert_array_equal(states, reference["x"])
    np.testing.assert_array_equal(disturbances, np.sin(100.0 + STEP * np.arange(STEPS)))
    with FmuPlant(scenario) as plant:
        run = simulate(plant, Playback(ACTIONS[:, None]), STEPS, 0)
    np.testing.assert_array_equal(run["time"], STEP * np.arange(STEPS))


def test_start_time_and_tolerance_are_those_of_the_file_unless_stated(tmp_path):
    experiment = '<DefaultExperiment startTime="50" stopTime="60" tolerance="1e-4"/>'
    fmu = build_habits(tmp_path, experiment=experiment)
    reference = by_fmpy(fmu, 0, start_time=50.0)
    np.testing.assert_array_equal(driven(habit_scenario(tmp_path, fmu))[0], reference["x"])
    other = by_fmpy(fmu, 0, start_time=0.0, relative_tolerance=1e-2)
    stated = habit_scenario(tmp_path, fmu, start_time=0.0, tolerance=1e-2)
    np.testing.assert_array_equal(driven(stated)[0], other["x"])


def test_a_run_goes_on_beyond_the_files_stop_time_and_to_a_stated_one(made):
    with FmuPlant(made()) as plant:
        assert len(simulate(plant, Playback(np.ones((20, 1))), 20, 0)["x"]) == 20
        assert plant.scenario.hash == made().hash
    told = probe(made(NEEDS_STOP, stop_time=40.0)).experiment.stop_time
    assert (told, probe(made(NEEDS_STOP)).experiment.stop_time) == (40.0, 4.0)


@pytest.mark.parametrize(("habits", "end"), [(0, 0), (LAGGED, 0), (FREE, 0), (EAGER, 1)])
def test_the_outputs_of_a_sample_of_several_steps_are_those_of_its_first(made, habits, end):
    _, costs, _ = driven(made(habits, communication_step=STEP / 4))
    fine = made(habits).replace({"sampling_time": STEP / 4})
    with FmuPlant(fine) as plant:
        states = [plant.reset(0)[0]]
        states += [plant.step([u]).s[0] for u in np.repeat(ACTIONS, 4)]
    expected = (np.array(states)[end:-1:4][:STEPS] - 2.0) ** 2
    np.testing.assert_array_equal(costs, expected + (0.0 if habits == FREE else ACTIONS**2))


def test_a_step_of_its_own_is_refused_unless_it_is_the_samples(tmp_path):
    fmu = build_habits(tmp_path, experiment='<DefaultExperiment stepSize="0.25"/>')
    with pytest.raises(PlantError, match=r"however long .* own step is 0\.25 s .*, not 0\.5 s"):
        FmuPlant(habit_scenario(tmp_path, fmu, OWN_STEP))
    fitting = habit_scenario(tmp_path, fmu, OWN_STEP, communication_step=0.25)
    ordinary = habit_scenario(tmp_path, fmu, communication_step=0.25)
    np.testing.assert_array_equal(driven(fitting)[0], driven(ordinary)[0])


def test_a_step_that_came_nowhere_is_an_error(tmp_path):
    fmu = build_habits(tmp_path, 3)
    with FmuPlant(habit_scenario(tmp_path, fmu, STUCK)) as plant:
        plant.reset(0)
        with pytest.raises(PlantError, match="ended the step early, at 0"):
            plant.step([1.0])


def test_a_report_says_what_was_found(made):
    report = probe(made(LAGGED | NO_RESET | ENABLED, outputs=None))
    assert (report.outputs, report.restart, report.snapshots) == ("after-step", Restart.FRESH, True)
    assert set(report.kinds) == {"cost", "d"}
    assert report.still == {"u": True}
    assert report.undriven == {"enable": "0"}
    assert report.starts_anywhere
    assert all(row.subject and row.finding for row in report.rows)


def test_an_fmu_that_bears_small_changes_only_is_tried_with_those(made):
    assert probe(made(FRAIL)).kinds == {"cost": OutputKind.FOLLOWS, "d": OutputKind.INSTANT}
    assert probe(made(FRAIL | LAGGED)).kinds == {"cost": OutputKind.SAMPLE, "d": OutputKind.SAMPLE}


def test_a_plant_with_noise_of_its_own_is_read_in_the_order_that_fmi_allows(made):
    report = probe(made(RESTLESS))
    assert set(report.kinds.values()) == {OutputKind.OPEN}
    assert (report.outputs, report.restart) == ("after-step", Restart.FRESH)


def test_our_own_fmus_are_seen_as_they_are():
    for name in (*fmus.NAMES, *fmus.PLANTS):
        report = probe(name)
        assert (report.outputs, report.restart) == ("before-step", Restart.RESET), name
        assert report.snapshots, name
        assert report.serialises, name
    assert probe(Scenario.load("paper")).kinds["economic_cost"] is OutputKind.FOLLOWS
