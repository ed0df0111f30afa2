"""`cosim fmu`: exit codes, tables and JSON of its commands."""

import json
import time
import zipfile

import pytest

import fmus
from tests.helpers.compiler import needs_compiler


def test_info_as_json(cosim):
    code, out, _ = cosim("fmu", "info", "evaporator_fmi3", "--json")
    document = json.loads(out)
    assert (code, document["fmi_version"]) == (0, "3.0")
    assert {"name", "unit", "start", "min", "max"} <= set(document["variables"][0])
    assert document["refusals"] == []


@pytest.mark.slow
def test_info_on_200_000_variables_takes_seconds(cosim, tmp_path):
    variable = '<Float64 name="v{0}" valueReference="{0}" description="one"/>'
    many = "".join(map(variable.format, range(100_000, 300_000)))
    with (
        zipfile.ZipFile(fmus.path("evaporator_fmi3")) as shipped,
        zipfile.ZipFile(tmp_path / "big.fmu", "w", zipfile.ZIP_DEFLATED) as big,
    ):
        for name in shipped.namelist():
            text = shipped.read(name)
            if name == "modelDescription.xml":
                text = text.replace(b"</ModelVariables>", f"{many}</ModelVariables>".encode())
            big.writestr(name, text)
    begin = time.process_time()
    code, out, _ = cosim("fmu", "info", "big.fmu", "--json")
    assert time.process_time() - begin < 20
    assert code == 0
    assert len(json.loads(out)["variables"]) > 200_000


def test_check_runs_the_fmu_and_ends_with_0(cosim):
    code, out, _ = cosim("fmu", "check")
    assert code == 0
    assert "all finite" in out


def test_failed_check_ends_with_1(cosim, monkeypatch):
    from fmus import check

    failed = check.Finding("subject", "failed", "why")
    monkeypatch.setattr(check, "check", lambda path: [failed])
    code, out, _ = cosim("fmu", "check", "--json")
    assert code == 1
    assert json.loads(out) == {"passed": False, "checks": [vars(failed)]}


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
