"""`cosim fmu`: exit codes, tables and JSON of its commands."""

import json
import time
import zipfile

import pytest

import fmus
from tests.helpers.compiler import needs_compiler
from tests.helpers.kinds import build_kind
from tests.helpers.tank import edited


def test_info_as_json(cosim):
    code, out, _ = cosim("fmu", "info", "evaporator_fmi3", "--json")
    document = json.loads(out)
    assert (code, document["fmi_version"]) == (0, "3.0")
    assert {"name", "unit", "start", "min", "max"} <= set(document["variables"][0])
    assert document["refusals"] == []


def with_more_variables(path, number):
    """Write the evaporator's FMU with so many variables more."""
    variable = '<Float64 name="v{0}" valueReference="{0}" description="one"/>'
    many = "".join(map(variable.format, range(100_000, 100_000 + number)))
    with (
        zipfile.ZipFile(fmus.path("evaporator_fmi3")) as shipped,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as big,
    ):
        for name in shipped.namelist():
            text = shipped.read(name)
            if name == "modelDescription.xml":
                text = text.replace(b"</ModelVariables>", f"{many}</ModelVariables>".encode())
            big.writestr(name, text)


@pytest.mark.slow
def test_ten_times_the_variables_take_about_ten_times_the_work_of_info(cosim, tmp_path):
    """Work that grows by the square would be a hundred times as much."""
    seconds = []
    for number in (20_000, 200_000):
        with_more_variables(tmp_path / "big.fmu", number)
        begin = time.process_time()
        code, out, _ = cosim("fmu", "info", "big.fmu", "--json")
        seconds.append(time.process_time() - begin)
        assert code == 0
        assert len(json.loads(out)["variables"]) > number
    assert seconds[1] < 30 * seconds[0]


def test_check_says_that_a_plant_can_be_one_and_how(cosim):
    code, out, _ = cosim("fmu", "check")
    assert code == 0
    assert out.splitlines()[-1] == "it can be a plant"
    code, out, _ = cosim("fmu", "check", "--json")
    found = json.loads(out)
    assert (code, found["usable"], found["remarks"]) == (0, True, [])
    assert found["outputs"] == "before-step"
    assert sorted(found["undriven_inputs"]) == ["F1_in", "T1_in", "T200_in", "X1_in"]


def test_check_ends_with_1_where_it_cannot_be_one(cosim, tmp_path):
    face = 'ModelExchange modelIdentifier="kinds"'
    for fmu, words in (
        (build_kind(tmp_path, 2, face=face), "has no co-simulation interface"),
        (build_kind(tmp_path, 3, data=b"text"), "is not a shared library"),
    ):
        code, out, _ = cosim("fmu", "check", fmu)
        assert code == 1
        assert words in out.splitlines()[-1]


def test_check_reads_what_is_flawed_and_lists_the_flaws(cosim, tmp_path):
    fmu = build_kind(tmp_path, 2)
    edited(fmu, tmp_path / "flawed.fmu", lambda text: text.replace('"u"', '"u" colour="red"'))
    code, out, err = cosim("fmu", "check", tmp_path / "flawed.fmu", "--sampling-time", 0.5)
    assert (code, err) == (0, "")
    assert "attribute 'colour' is not allowed" in out
    assert out.splitlines()[-1].startswith("it can be a plant")


@needs_compiler
def test_build_writes_both_files_and_makes_the_folder(cosim, tmp_path):
    code, out, _ = cosim("fmu", "build", "--out", "new/folder", "--json")
    assert code == 0
    names = [f"{name}.fmu" for name in fmus.NAMES]
    assert sorted(p.name for p in (tmp_path / "new/folder").iterdir()) == names
    assert json.loads(out)["built"] == [f"new/folder/{name}" for name in names]


def test_missing_compiler_is_told(cosim, monkeypatch):
    monkeypatch.setenv("CC", "no-such-compiler")
    code, _, err = cosim("fmu", "build", "--out", "x")
    assert code == 2
    assert "install gcc or set CC" in err
