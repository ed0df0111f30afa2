"""`cosim export`: the FMU and the SSP that it writes, and what it refuses."""

import json
import subprocess
import sys
import zipfile
from importlib.metadata import version
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import attr
import fmpy
import numpy as np
import pytest
from typer.testing import CliRunner

import fmus
from benchmarks import importers
from controllers import Parameters
from controllers.factories import naive, nmpc, tuned
from controllers.problem import Problem
from controllers.theta import ThetaBlocks
from cosim import FmuPlant, Scenario, simulate
from cosim.cli.controller_fmu import rti_controller, sampled_controller
from cosim.cli.main import app
from fmus.build import build_model
from tests.helpers.compiler import needs_compiler
from tests.helpers.instance import Instance

pytestmark = needs_compiler
EXAMPLES = Path(__file__).parents[3] / "examples"
SAMPLES = 60
ASSAY = ["naive", "-s", "assay", "--out", "c.fmu"]
ACTION = 1e-9


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A tuned controller's FMU for FMI 2.0, its loop with seed 5, and the command's JSON."""
    folder = tmp_path_factory.mktemp("export")
    fmu, ssp = folder / "controller.fmu", folder / "loop.ssp"
    command = f"export tuned --out {fmu} --ssp {ssp} --seed 5 --local --json"
    result = CliRunner().invoke(app, command.split(), catch_exceptions=False)
    return fmu, ssp, json.loads(result.stdout)


@pytest.mark.slow
def test_every_installed_importer_takes_the_fmu(exported):
    findings = importers.check(exported[0])
    assert not [f for f in findings if f.status == importers.FAILED], findings
    assert [f for f in findings if f.status == importers.PASSED]


def test_its_variables_have_the_plants_names_and_units_and_theta_is_tunable(exported):
    description = fmpy.read_model_description(str(exported[0]))
    assert description.generationTool == f"rti-cosim {version('rti-cosim')}"
    found = {v.name: v for v in description.modelVariables}
    assert [found[name].causality for name in ("X2", "P2", "P100", "F200")] == [
        "input", "input", "output", "output",
    ]  # fmt: skip
    assert (found["P100"].unit, found["P100"].min, found["P100"].max) == ("kPa", "100.0", "400.0")
    assert found["theta.B_l[0,2]"].variability == "tunable"
    assert {"value", "qp_status", "kkt_residual", "predicted.X2[10]"} <= set(found)
    with zipfile.ZipFile(exported[0]) as container:
        record = json.loads(container.read("extra/org.rti-cosim/controller.json"))
    assert record["theta_hash"] == exported[2]["theta_hash"]


def test_fmpy_alone_runs_the_loop_as_cosim_does(exported):
    """The twenty lines of the example; the two QP solvers differ by rounding."""
    printed = master("-W", "error", EXAMPLES / "fmpy_ssp.py", exported[1], SAMPLES)
    rows = np.array([list(map(float, line.split(","))) for line in printed[1:]])
    scenario = Scenario.load("paper")

    with FmuPlant(scenario) as plant:
        expected = simulate(plant, tuned(scenario), SAMPLES, 5)
    for column, name in enumerate(("X2", "P2", "P100", "F200"), start=1):
        np.testing.assert_allclose(rows[:, column], expected[name], rtol=0, atol=ACTION)


FMI3 = {"plant": {"fmu": "evaporator_fmi3"}, "disturbance": {"law": "normal"}}


@pytest.mark.slow
@pytest.mark.usefixtures("quickly_built")
@pytest.mark.parametrize(
    ("name", "changes", "fmi"), [("reactor", {}, 2), ("tanks", {}, 3), ("paper", FMI3, 3)]
)
def test_the_example_runs_any_plants_loop(cosim, tmp_path, name, changes, fmi):
    """Of FMI 2.0, of FMI 3.0, which is SSP 2.0, and of both."""
    scenario = Scenario.load(name).replace(changes | {"controller": {"horizon": 3}})
    (tmp_path / "s.toml").write_text(scenario.to_toml())
    files = f"-o {tmp_path / 'c.fmu'} --ssp {tmp_path / 'l.ssp'} -s {tmp_path / 's.toml'}"
    assert cosim(*f"export naive {files} --fmi {fmi} --seed 5 --local".split())[0] == 0
    head, *printed = master("-W", "error", EXAMPLES / "fmpy_ssp.py", tmp_path / "l.ssp", 10)
    assert head.split(",") == ["time", *scenario.plant.states, *scenario.plant.actions]
    with FmuPlant(scenario) as plant:
        expected = simulate(plant, naive(scenario), 10, 5)
    rows = np.array([list(map(float, line.split(","))) for line in printed])
    for column, signal in enumerate(head.split(",")[1:], start=1):
        np.testing.assert_allclose(rows[:, column], expected[signal], rtol=1e-8)


def test_both_ends_of_a_connection_have_the_plants_unit(exported):
    with zipfile.ZipFile(exported[1]) as container:
        root = ElementTree.fromstring(container.read("SystemStructure.ssd"))
    units = [
        (each.get("name"), each.find("{*}Real").get("unit"))
        for each in root.findall(".//{*}Connector")
    ]
    assert len(units) == 8
    plant = fmpy.read_model_description(str(fmus.path("evaporator")))
    expected = {(v.name, v.unit) for v in plant.modelVariables if v.name in dict(units)}
    assert set(units) == expected
    found = root.findall(".//{*}Unit")
    defined = {each.get("name"): each.find("{*}BaseUnit").attrib for each in found}
    for unit in (u for u in plant.unitDefinitions if u.name in dict(expected).values()):
        given = {key: float(value) for key, value in defined.pop(unit.name).items()}
        assert given == attr.asdict(unit.baseUnit)
    assert not defined


def master(*words):
    """The lines that a script prints which runs an SSP."""
    return subprocess.check_output([sys.executable, *map(str, words)], text=True).split()


def rows_by(name, ssp, step, samples):
    """Rows of numbers of a run by another master."""
    words = master(Path(__file__).parents[2] / "helpers" / f"ssp_by_{name}.py", ssp, step, samples)
    found = [after for word, after in pairwise(words) if word == "row"]
    return np.array([list(map(float, row.split(","))) for row in found])


def test_another_instance_goes_on_from_its_bytes_with_the_same_bits(exported, tmp_path):
    """The guess and the QP solver's working set are part of the state."""
    fmpy.extract(str(exported[0]), str(tmp_path))
    one, other = (Instance(tmp_path, 2).initialise() for _ in range(2))
    names = [v.name for v in one.variables.values() if v.type == "Real"]
    states = np.random.default_rng(0).normal((25.3, 50.0), (0.5, 1.0), (12, 2))
    for k, s in enumerate(states):
        if k == 6:
            other.restore(other.deserialise(one.serialise(one.save())))
        found = []
        for fmu in (one,) if k < 6 else (one, other):
            fmu.set(X2=s[0], P2=s[1])
            fmu.step(60.0 * k)
            found.append(fmu.get(*names))
        assert found[0] == found[-1]
    one.close()
    other.close()


@pytest.mark.usefixtures("quickly_built")
@pytest.mark.parametrize("version", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_theta_may_change_between_samples(tmp_path, version):
    """All of it, a bound alone, a parameter of the model: as the Python controller's θ."""
    scenario = Scenario.load("paper").replace({"controller": {"horizon": 3}})
    problem = Problem.from_scenario(scenario)
    blocks = ThetaBlocks.from_problem(problem, model_parameters=("UA2",))
    naive_theta = Parameters.naive(problem, blocks)
    controller = nmpc(scenario, naive_theta.replace({"b_l": [0.1, 0.0, 0.2, 0.1]}))
    system = sampled_controller(controller, scenario)
    fmpy.extract(str(build_model(system, tmp_path / "c.fmu", version)), str(tmp_path / "unzipped"))
    fmu = Instance(tmp_path / "unzipped", version).initialise()
    everything = {block.name: naive_theta[block.name] for block in blocks}
    names = [v.name for v in system.variables if v.name.startswith("theta.")]
    arrays = system.arrays if version == 3 else {}
    changes = [{}, {"x_l": [25.4, 40.0]}, {"p": [5.0]}, {}, everything]
    states = np.random.default_rng(2).normal((25.5, 50.0), (0.3, 0.5), (len(changes), 2))
    actions = []
    for k, (s, change) in enumerate(zip(states, changes, strict=True)):
        controller.parameters = controller.parameters.replace(change)
        values = dict(zip(names, controller.theta.tolist(), strict=True))
        for name, elements in arrays.items():
            if name.startswith("theta."):
                values[name] = [values.pop(each.name) for each in elements]
        references = [fmu.reference(name) for name in values]
        numbers = np.hstack(list(values.values())).tolist()
        (fmu.fmu.setReal if version == 2 else fmu.fmu.setFloat64)(references, numbers)
        fmu.set(X2=s[0], P2=s[1])
        fmu.step(60.0 * k)
        controller.prepare()
        actions.append(controller.feedback(s).action)
        np.testing.assert_allclose(fmu.get("P100", "F200"), actions[-1], rtol=0, atol=ACTION)
    assert len({tuple(action) for action in actions}) == len(actions)


@pytest.mark.slow
@pytest.mark.usefixtures("quickly_built")
@pytest.mark.parametrize("version", [2, 3])
def test_automatic_goes_on_from_what_the_operator_did_in_manual(tmp_path, version):
    """As the Python controller that is told of the actions; outside the bounds they are clipped."""
    scenario = Scenario.load("paper").replace({"controller": {"horizon": 3}})
    controller = rti_controller("tuned", scenario)
    system = sampled_controller(controller, scenario)
    names = ("time", "X2", "P2", "manual", "manual_P100", "manual_F200")
    rows = [
        (0.0, 25.0, 49.7, False, 0.0, 0.0),
        (60.0, 25.4, 50.0, True, 230.0, 190.0),
        (120.0, 26.0, 50.5, True, 500.0, 0.0),
        (180.0, 25.5, 51.0, False, 230.0, 190.0),
        (240.0, 25.2, 51.0, False, 230.0, 190.0),
    ]
    result = fmpy.simulate_fmu(
        str(build_model(system, tmp_path / "controller.fmu", version)),
        stop_time=300.0,
        step_size=60.0,
        output_interval=60.0,
        input=np.array(rows, dtype=[(n, bool if n == "manual" else float) for n in names]),
        output=["P100", "F200", "value"],
    )
    for (_, *s, manual, P100, F200), found in zip(rows, result.tolist()[1:], strict=True):
        given = np.clip((P100, F200), scenario.action_lower, scenario.action_upper)
        controller.prepare()
        solution = controller.feedback(s, given if manual else None)
        np.testing.assert_allclose(found[1:3], solution.action, rtol=0, atol=ACTION)
        np.testing.assert_allclose(found[3], solution.value, rtol=1e-9)
        if manual:
            assert found[1:3] == tuple(given.tolist())


@pytest.mark.slow
@pytest.mark.usefixtures("quickly_built")
def test_a_measured_feed_spares_violations(tmp_path):
    """The actions are the Python controller's with this p; it is θ's own where the sensor fails."""
    thinner = {"changes": [{"time": 600.0, "parameters": {"X1_nominal": 4.5}}]}
    scenario, violation = Scenario.load("paper").replace({"plant": thinner}), [0.0, 0.0]
    controller = rti_controller("tuned", scenario, ("X1",))
    system = sampled_controller(controller, scenario, ("X1",))
    fmpy.extract(str(build_model(system, tmp_path / "c.fmu")), str(tmp_path / "c"))
    for measured in (False, True):
        fmu = Instance(tmp_path / "c", 2).initialise()
        controller.reset()
        with FmuPlant(scenario) as plant:
            s = plant.reset(3)
            for k in range(100):
                sensor = np.nan if k == 50 else 4.5 if measured and k >= 10 else 5.0
                fmu.set(X2=s[0], P2=s[1], X1=sensor)
                fmu.step(60.0 * k)
                controller.theta = np.r_[controller.theta[:-1], np.nan_to_num(sensor, nan=5.0)]
                controller.prepare()
                action = fmu.get("P100", "F200")
                ours = controller.feedback(s).action
                np.testing.assert_allclose(ours, action, rtol=0, atol=1e-10)
                s = plant.step(action).s
                violation[measured] += max(25.0 - s[0], 0.0)
    assert violation[True] < 0.9 * violation[False]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "package"), [("libcosim", "libcosimpy"), ("ecos", "ecospy.EcosSimulation")]
)
def test_other_masters_run_the_ssp_with_an_error_of_first_order_in_their_step(
    cosim, tmp_path, name, package
):
    """They step plant and controller side by side: an action arrives one step of theirs late.

    libcosim ignores FMI 2.0's enumerations: the SSP sets the integer beside the law's.
    """
    pytest.importorskip(package, exc_type=Exception)
    normal = Scenario.load("paper").replace({"disturbance": {"law": "normal"}})
    (tmp_path / "normal.toml").write_text(normal.to_toml())
    words = "export tuned -s normal.toml -o c.fmu --ssp l.ssp --seed 3 --local"
    assert cosim(*words.split())[0] == 0
    with FmuPlant(normal) as plant:
        expected = simulate(plant, tuned(normal), 20, 3)
    errors = []
    for step in ("6.0", "3.0"):
        rows = rows_by(name, tmp_path / "l.ssp", step, 20)
        assert rows[1:, 2].tolist() == expected["X1"][1:].tolist()
        errors.append(np.abs(rows[1:, 0] - expected["X2"][1:]).max())
    assert errors[0] < 0.5
    assert errors[1] < 0.6 * errors[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["converged", "--out", "c.fmu"], "is no RTI-NMPC and cannot be exported"),
        (["nothing.toml", "--out", "c.fmu"], "nothing.toml' does not exist"),
        (["naive", "--out", "c.fmu", "--measured", "UA2"], "has not all of UA2 to measure"),
        (["naive", "--out", "no/such/folder/c.fmu", "--local"], "no/such/folder"),
        ([*ASSAY, "--measured", "X1"], "leave --measured out"),
        ([*ASSAY, "--format", "c", "--single"], "leave --single out"),
        ([*ASSAY, "--ssp", "loop.ssp"], "has sensors, whose noise and delays no FMU has"),
        (["naive", "-s", "prices", "--out", "c.fmu", "--ssp", "l.ssp"], "which no FMU of the loop"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_one_line(
    cosim, monkeypatch, tmp_path, arguments, message
):
    monkeypatch.chdir(tmp_path)
    code, out, err = cosim("export", *arguments)
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())
