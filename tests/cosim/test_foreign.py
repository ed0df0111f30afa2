"""FMUs that this project did not write, or that misbehave."""

import json
import os
import re
import subprocess
import sys

import numpy as np
import pytest

import fmus
from cosim import FmuPlant, Scenario, simulate
from cosim.core.errors import CapabilityError, FmuWarning, PlantError, ScenarioError
from cosim.plant.fmi import unpack
from tests.helpers.command import run_cosim
from tests.helpers.kinds import REALS, build_kind, scenario_for
from tests.helpers.loop import Hold
from tests.helpers.tank import build_tank, edited, write_scenario


@pytest.fixture(scope="module")
def tanks(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tank")
    return {saves: build_tank(folder, saves) for saves in (True, False)}


@pytest.mark.parametrize("saves", [True, False])
def test_a_foreign_fmu_runs_in_the_loop(tanks, tmp_path, saves):
    with FmuPlant(write_scenario(tmp_path, tanks[saves])) as plant:
        trajectory = simulate(plant, Hold([2.0]), 20, seed=0)
    k = np.arange(20)
    expected = 2.0 + (1.0 - 2.0) * np.exp(-k * 0.5 / 4.0)
    np.testing.assert_allclose(trajectory["x"], expected, rtol=1e-12)
    np.testing.assert_array_equal(trajectory["stage_cost"], np.full(20, 4.0))
    np.testing.assert_array_equal(trajectory["penalty"], np.zeros(20))
    assert trajectory.signals["x"].unit == "m"
    assert trajectory.disturbances.shape == (20, 0)


def test_a_foreign_fmu_that_saves_its_state_has_snapshots(tanks, tmp_path):
    with FmuPlant(write_scenario(tmp_path, tanks[True])) as plant:
        plant.reset(0)
        plant.step([3.0])
        snapshot = plant.snapshot()
        expected = plant.step([2.0]).s
        plant.restore(snapshot)
        np.testing.assert_array_equal(plant.step([2.0]).s, expected)
        with pytest.raises(CapabilityError, match=r"serialise its state.*canSerializeFMUstate"):
            plant.serialise(snapshot)


def test_a_missing_capability_is_an_error_only_when_asked_for(tanks, tmp_path):
    with FmuPlant(write_scenario(tmp_path, tanks[False], mapped=False)) as plant:
        plant.reset(0)
        plant.step([3.0])
        with pytest.raises(CapabilityError, match=r"save and restore.*canGetAndSetFMUstate"):
            plant.snapshot()
        with pytest.raises(CapabilityError, match=r"plant\.mapping\.initial_state"):
            plant.reset(0, [2.0])
        plant.reset(0)
        plant.step([3.0])


@pytest.mark.parametrize(
    ("fault", "words"), [(2, "error: tank: out of water"), (3, "fatal: tank: burst")]
)
def test_a_failed_call_reports_what_the_fmu_logged(tanks, tmp_path, fault, words):
    with FmuPlant(write_scenario(tmp_path, tanks[True], fault=fault)) as plant:
        plant.reset(0)
        with pytest.raises(PlantError, match=f"fmi2DoStep returned {words}"):
            plant.step([1.0])
        if fault == 3:
            with pytest.raises(PlantError, match="fatal"):
                plant.reset(0)


@pytest.mark.slow
def test_a_chatty_fmu_does_not_spoil_json(tanks, tmp_path):
    scenario = write_scenario(tmp_path, tanks[True], fault=4)
    words = ["simulate", "--scenario", scenario, "--out", tmp_path / "out", "--json"]
    result = run_cosim(*words, "--controller", "tests.helpers.loop:hold", "--steps", "3")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["samples"] == 3
    assert "a chatty FMU" in result.stderr


CS = 'CoSimulation modelIdentifier="kinds" '
VARIABLE_STEP = 'canHandleVariableCommunicationStepSize="true"'


@pytest.fixture(params=[2, 3], ids=["fmi2", "fmi3"])
def version(request):
    return request.param


def trajectory(scenario, seed=0, steps=3):
    with FmuPlant(scenario) as plant:
        rows = [plant.reset(seed)[0]]
        return rows + [plant.step([2.0]).s[0] for _ in range(steps)]


def expected(steps=3, start=1.0, push=0.0):
    rows = [start]
    for _ in range(steps):
        rows.append(rows[-1] + 0.5 * (2.0 - rows[-1]) + push)
    return rows


def test_references_that_collide_between_types_are_kept_apart(tmp_path):
    """FMI 2.0: u is Real 0 and seed Integer 0, x is Real 1 and fault Integer 1."""
    scenario = scenario_for(tmp_path, build_kind(tmp_path, 2), parameters=", range = 0.125")
    assert trajectory(scenario, seed=4) == expected(push=0.5)
    assert trajectory(scenario, seed=0) == expected()


FMI2_LEVEL = (
    '<ScalarVariable name="level" valueReference="2" causality="input" variability="discrete">'
    '<Integer start="0"/></ScalarVariable>'
)
FMI3_INPUTS = (
    '<Int32 name="level" valueReference="22" causality="input" variability="discrete" start="0"/>'
    '<Float32 name="single" valueReference="30" causality="input" start="0"/>'
    '<Float64 name="profile" valueReference="5" causality="input" start="0.25 0 0.75">'
    '<Dimension start="3"/></Float64>'
)


@pytest.mark.parametrize(
    ("version", "action", "given", "acts"),
    [
        (2, "level", 1.6, 2.0),
        (3, "level", 2.4, 2.0),
        (3, "single", 2.1, float(np.float32(2.1))),
        (3, "profile[1]", 2.1, 2.1),
    ],
)
def test_actions_of_other_types_and_elements_of_arrays(tmp_path, version, action, given, acts):
    fmu = build_kind(tmp_path, version, more=FMI2_LEVEL if version == 2 else FMI3_INPUTS)
    others = {"seed": 3.0} | ({} if version == 2 else {"profile[0]": 0.25, "profile[2]": 0.75})
    changes = {"plant": {"actions": [action], "disturbances": list(others)}}
    scenario = Scenario.load(scenario_for(tmp_path, fmu)).replace(changes)
    with FmuPlant(scenario) as plant:
        assert not plant.drivable
        for _ in range(2):
            x = plant.reset(3)[0]
            for _ in range(3):
                step = plant.step([given])
                x += 0.5 * (acts - x)
                assert (step.s[0], step.stage_cost) == (x, acts * acts)
                assert step.disturbance.tolist() == list(others.values())
        assert simulate(plant, Hold([given]), 4, 0)["x"][-1] == x


def test_an_element_that_an_array_does_not_have_is_refused(tmp_path):
    fmu = build_kind(tmp_path, 3, more=FMI3_INPUTS)
    scenario = Scenario.load(scenario_for(tmp_path, fmu))
    for name in ("profile", "profile[3]", "profile[-1]", "profile[1,0]", "profile[a]", "profile[]"):
        with pytest.raises(PlantError, match=r"name an element, up to profile\[2\]"):
            FmuPlant(scenario.replace({"plant": {"actions": [name]}}))


def test_a_string_is_no_obstacle_unless_it_is_named(tmp_path, version):
    common = 'name="label" valueReference="30" causality="parameter" variability="fixed"'
    more = (
        f'<ScalarVariable {common}><String start="a"/></ScalarVariable>'
        if version == 2
        else f'<String {common}><Start value="a"/></String>'
    )
    fmu = build_kind(tmp_path, version, more=more)
    assert trajectory(scenario_for(tmp_path, fmu)) == expected()
    named = scenario_for(tmp_path, fmu, parameters=", label = 1.0")
    with pytest.raises(PlantError, match=r"'label'.* is a String, which cannot be set here"):
        FmuPlant(named)


def test_a_step_that_ends_the_simulation_is_an_error(tmp_path):
    scenario = scenario_for(tmp_path, build_kind(tmp_path, 3), fault=13)
    with FmuPlant(scenario) as plant:
        plant.reset(0)
        with pytest.raises(PlantError, match=r"the FMU ended the run, at 0\.5 s"):
            plant.step([1.0])


def test_a_tunable_parameter_serves_as_action(tmp_path, version):
    reals = REALS.replace("u     0  input      -        0", "u 0 parameter tunable 0")
    fmu = build_kind(tmp_path, version, reals=reals)
    assert trajectory(scenario_for(tmp_path, fmu)) == expected()


@pytest.mark.parametrize("size", ["0.5", "0.125"])
def test_a_constant_step_may_have_any_size(tmp_path, version, size):
    """canHandleVariableCommunicationStepSize, false by default, forbids that the size changes."""
    experiment = f'<DefaultExperiment stepSize="{size}"/>'
    fmu = build_kind(tmp_path, version, face=CS, experiment=experiment)
    assert trajectory(scenario_for(tmp_path, fmu)) == expected()


def test_an_output_that_starts_exactly_is_its_own_start_parameter(tmp_path, version):
    plain = build_kind(tmp_path, version)
    path = scenario_for(tmp_path, tmp_path / f"exact{version}.fmu")
    path.write_text(path.read_text().replace('"x_start"', '"x"'))
    with pytest.raises(PlantError, match="without a start"):
        FmuPlant(Scenario.load(path).replace({"plant": {"fmu": str(plain)}}))
    reals = re.sub(r"(?m)^(x +1 .* )-", r"\g<1>1", REALS)
    exact = 'name="x" initial="exact"'
    edited(
        build_kind(tmp_path, version, reals=reals),
        tmp_path / f"exact{version}.fmu",
        lambda text: text.replace('name="x"', exact),
    )
    FmuPlant(path).close()


def test_a_fixed_internal_step_takes_its_multiples(tmp_path):
    fmu = build_kind(tmp_path, 3, face=f'{CS} fixedInternalStepSize="0.25"')
    assert trajectory(scenario_for(tmp_path, fmu)) == expected()
    with pytest.raises(PlantError, match=r"multiples of 0\.25 s .*communication step of 0\.6 s is"):
        FmuPlant(scenario_for(tmp_path, fmu, sampling_time=0.6))


def test_a_sample_is_made_of_the_steps_that_the_scenario_names(tmp_path, version):
    """For FMUs that integrate by their communication step, as OpenModelica's and pythonfmu's do."""
    scenario = Scenario.load(scenario_for(tmp_path, build_kind(tmp_path, version)))
    changes = {"plant": {"communication_step": 0.125, "stage_cost": "x"}}
    with FmuPlant(scenario.replace(changes)) as plant:
        x = plant.reset(0)[0]
        for _ in range(3):
            begin, step = x, plant.step([2.0])
            for _ in range(4):
                x += 0.125 * (2.0 - x)
            assert (step.s[0], step.stage_cost) == (x, begin)
        assert simulate(plant, Hold([2.0]), 4, 0)["x"][-1] == x
    with pytest.raises(ScenarioError, match="communication_step: must be a divisor of sampling_"):
        scenario.replace({"plant": {"communication_step": 0.2}})
    fixed = build_kind(tmp_path, 3, face=f'{CS} fixedInternalStepSize="0.25"')
    changes = {"plant": {"fmu": str(fixed), "communication_step": 0.125}}
    with pytest.raises(PlantError, match=r"communication step of 0\.125 s is none"):
        FmuPlant(scenario.replace(changes))


def test_one_instance_per_process_is_kept_to(tmp_path, version):
    face = f'{CS} {VARIABLE_STEP} canBeInstantiatedOnlyOncePerProcess="true"'
    scenario = scenario_for(tmp_path, build_kind(tmp_path, version, face=face))
    with (
        FmuPlant(scenario),
        pytest.raises(CapabilityError, match="only once per process; close the other"),
    ):
        FmuPlant(scenario)
    assert trajectory(scenario) == expected()


def test_one_that_needs_its_tool_runs_where_the_tool_is_there(tmp_path, version):
    """As those of pythonfmu do, whose tool is Python; where it is not, the line says so."""
    tool = 'needsExecutionTool="true"'
    fmu = build_kind(tmp_path, version, face=f"{CS} {VARIABLE_STEP} {tool}")
    assert trajectory(scenario_for(tmp_path, fmu)) == expected()
    name, token = {2: ("evaporator", "guid"), 3: ("evaporator_fmi3", "instantiationToken")}[version]

    def refused(text):
        text = text.replace("<CoSimulation ", f"<CoSimulation {tool} ")
        return re.sub(f' {token}="[^"]*"', f' {token}="none"', text)

    other = edited(fmus.path(name), tmp_path / "other.fmu", refused)
    with pytest.raises(PlantError, match=r"instantiated.*needs the tool .*: .*the token differs"):
        FmuPlant("paper", other)


SLAVE = """
import {module}
from pythonfmu import Fmi2Causality, Fmi2Slave, Real

class Slave(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.x, self.u, self.cost = 1.0, 0.0, 0.0
        self.register_variable(Real("x", causality=Fmi2Causality.output))
        self.register_variable(Real("cost", causality=Fmi2Causality.output))
        self.register_variable(Real("u", causality=Fmi2Causality.input))

    def do_step(self, time, step):
        self.x += step * (self.u - self.x)
        return True
"""


def test_one_of_pythonfmu_runs_or_names_the_module_that_it_lacks(tmp_path):
    pytest.importorskip("pythonfmu")
    (tmp_path / "elsewhere.py").write_text("")
    document = Scenario.load(scenario_for(tmp_path, build_kind(tmp_path, 2))).to_dict()
    document["plant"] |= {"parameters": {}, "mapping": {}}
    build = [sys.executable, "-m", "pythonfmu", "build", "-f"]
    for module in ("math", "elsewhere"):
        (tmp_path / f"with_{module}.py").write_text(SLAVE.format(module=module))
        environment = os.environ | {"PYTHONPATH": str(tmp_path)}
        subprocess.run([*build, f"with_{module}.py"], cwd=tmp_path, env=environment, check=True)
        (tmp_path / "Slave.fmu").rename(tmp_path / f"{module}.fmu")
    document["plant"]["fmu"] = str(tmp_path / "math.fmu")
    assert trajectory(Scenario.from_dict(document)) == expected()
    with pytest.raises(PlantError, match=r"(?s)instantiated.*needs the tool.*'elsewhere'"):
        FmuPlant(Scenario.from_dict(document), tmp_path / "elsewhere.fmu")


@pytest.mark.parametrize(("fault", "status"), [(1, -7), (2, 9)])
def test_a_status_that_fmi_does_not_have_is_an_error(tmp_path, version, fault, status):
    scenario = scenario_for(tmp_path, build_kind(tmp_path, version), fault=fault)
    with FmuPlant(scenario) as plant:
        plant.reset(0)
        with pytest.raises(PlantError, match=f"DoStep returned status {status}, which FMI does"):
            plant.step([1.0])


IDENTIFIERS = ("../../kinds", "/tmp/kinds", "a b", "kinds.so", "1kinds")
NO_PLANTS = [
    *(
        ({"face": f'CoSimulation modelIdentifier="{name}" {VARIABLE_STEP}'},
         r"modelIdentifier .*C identifier|invalid model description")
        for name in IDENTIFIERS
    ),
    ({"face": 'ModelExchange modelIdentifier="kinds"'},
     r"no co-simulation interface \(it has: model exchange\)"),
    ({"data": b"text"}, "is not a shared library"),
]  # fmt: skip


@pytest.mark.parametrize(("made", "words"), NO_PLANTS)
def test_what_is_no_plant_is_refused_with_the_reason(tmp_path, version, made, words):
    with pytest.raises(PlantError, match=words):
        FmuPlant(scenario_for(tmp_path, build_kind(tmp_path, version, **made)))


def test_an_archive_with_backslashes_runs(tmp_path, version):
    fmu = build_kind(tmp_path, version, separator="\\")
    assert trajectory(scenario_for(tmp_path, fmu)) == expected()
    assert (unpack(fmu).folder / "resources" / "readme.txt").read_bytes() == b"nothing"


def test_a_flawed_description_is_read_with_a_warning_and_runs(tmp_path, version):
    flawed = edited(
        build_kind(tmp_path, version),
        tmp_path / "flawed.fmu",
        lambda text: text.replace('name="u"', 'name="u" colour="red"'),
    )
    with pytest.warns(FmuWarning, match=r"'flawed\.fmu' is used although .*'colour'"):
        archive = unpack(flawed)
    assert len(archive.flaws) == 1
    assert trajectory(scenario_for(tmp_path, flawed)) == expected()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('="{kinds}"', '="{kinds}" x="y"', ""),
        (' guid="{kinds}"', "", "it has no guid"),
        (' modelIdentifier="kinds"', "", "its co-simulation has no modelIdentifier"),
        ('name="range"', 'name="x_start"', "two variables are called 'x_start'"),
        ("</ModelVariables>", "", "tag mismatch"),
    ],
)
def test_what_a_run_needs_is_asked_for_even_so(tmp_path, old, new, words):
    fmu = tmp_path / "other.fmu"
    edited(build_kind(tmp_path, 2), fmu, lambda text: text.replace(old, new))
    if not words:
        with pytest.warns(FmuWarning):
            unpack(fmu)
        return
    with pytest.raises(PlantError, match=f"invalid model description: .*{words}"):
        unpack(fmu)


def test_a_library_that_lacks_another_one_says_which(tmp_path):
    cc = ["cc", "-shared", "-fPIC", "-x", "c", "-", "-o"]
    build = {"input": b"int other(void) { return 1; }", "cwd": tmp_path}
    subprocess.run([*cc, "libother.so"], check=True, **build)
    link = ["-Wl,--no-as-needed", "-L.", "-lother"]
    subprocess.run([*cc, "kinds.so", "-x", "none", *link], check=True, **build)
    (tmp_path / "libother.so").unlink()
    fmu = build_kind(tmp_path, 2, data=(tmp_path / "kinds.so").read_bytes())
    with pytest.raises(PlantError, match=r"does not load: its 'kinds\.so' needs .* 'libother\.so'"):
        FmuPlant(scenario_for(tmp_path, fmu))


def test_the_resources_lie_where_a_uri_needs_no_escapes(tmp_path, monkeypatch):
    monkeypatch.setenv("COSIM_CACHE", str(tmp_path / "ca che é"))
    folder = unpack(build_kind(tmp_path, 2)).folder
    assert folder.as_uri() == f"file://{folder}"
