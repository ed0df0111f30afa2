import stat
import zipfile

import pytest

import fmus
from cosim.errors import PlantError
from cosim.plant import fmi
from cosim.plant.fmi import unpack
from tests.helpers.tank import edited


def test_a_shipped_fmu_is_found_by_name_and_unpacked_once():
    first = unpack("evaporator")
    assert first.path == fmus.path("evaporator").resolve()
    assert (first.folder / "modelDescription.xml").is_file()
    assert unpack("evaporator").folder == first.folder
    assert unpack(fmus.path("evaporator")).folder == first.folder


def test_a_rewritten_file_is_unpacked_anew(tmp_path):
    path = tmp_path / "copy.fmu"
    path.write_bytes(fmus.path("evaporator").read_bytes())
    first = unpack(path)
    path.write_bytes(fmus.path("evaporator_fmi3").read_bytes())
    second = unpack(path)
    assert first.sha256 != second.sha256
    assert second.description.fmiVersion == "3.0"


def _zip(path, entries):
    with zipfile.ZipFile(path, "w") as target:
        for name, data in entries:
            target.writestr(name, data)
    return path


def _link(path):
    info = zipfile.ZipInfo("resources/passwd")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    return _zip(path, [("modelDescription.xml", "<x/>"), (info, "/etc/passwd")])


def _truncated(path):
    data = fmus.path("evaporator").read_bytes()
    path.write_bytes(data[: len(data) // 2])
    return path


def _flipped(path):
    data = bytearray(fmus.path("evaporator").read_bytes())
    for at in range(2000, 40000, 500):
        data[at] ^= 0xFF
    path.write_bytes(data)
    return path


def _written(path, data):
    path.write_bytes(data)
    return path


REFUSED = {
    "text": (lambda p: _written(p, b"not a zip"), ["corrupt or not an FMU"]),
    "truncated": (_truncated, ["corrupt or not an FMU", "build it again"]),
    "flipped bits": (_flipped, ["corrupt or not an FMU"]),
    "no description": (lambda p: _zip(p, [("a", "b")]), ["no modelDescription.xml"]),
    "description is no XML": (
        lambda p: _zip(p, [("modelDescription.xml", "hello")]),
        ["unreadable model description"],
    ),
    "description breaks the schema": (
        lambda p: edited(fmus.path(), p, lambda text: text.replace("<ModelVariables>", "<Mod>", 1)
                         .replace("</ModelVariables>", "</Mod>", 1)),
        ["invalid model description", "Mod"],
    ),
    "FMI 1": (
        lambda p: edited(fmus.path(), p, lambda t: t.replace('fmiVersion="2.0"', 'fmiVersion="9"')),
        ["9"],
    ),
    "parent folder": (
        lambda p: _zip(p, [("../evil", "x")]),
        ["'../evil'", "leads outside"],
    ),
    "absolute": (lambda p: _zip(p, [("/etc/evil", "x")]), ["leads outside"]),
    "backslash": (lambda p: _zip(p, [("..\\evil", "x")]), ["leads outside"]),
    "drive": (lambda p: _zip(p, [("C:evil", "x")]), ["leads outside"]),
    "link": (_link, ["'resources/passwd' is a link"]),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_honest_fmu_is_refused_in_one_line(case, tmp_path):
    make, words = REFUSED[case]
    path = make(tmp_path / "bad.fmu")
    with pytest.raises(PlantError) as error:
        unpack(path)
    message = str(error.value)
    assert "bad.fmu" in message
    assert "\n" not in message
    for word in words:
        assert word in message
    assert not list(tmp_path.glob("**/evil"))


def test_an_archive_of_absurd_size_is_refused_before_it_is_unpacked(tmp_path, monkeypatch):
    path = _zip(tmp_path / "big.fmu", [("modelDescription.xml", "x" * 3000)])
    monkeypatch.setattr(fmi, "MAX_BYTES", 2999)
    with pytest.raises(PlantError, match="unpacks to more than"):
        unpack(path)
    monkeypatch.setattr(fmi, "MAX_ENTRIES", 0)
    with pytest.raises(PlantError, match="more than 0 entries"):
        unpack(path)


def test_an_fmu_without_a_binary_for_this_platform_says_what_it_has(tmp_path, paper):
    from cosim import FmuPlant

    path = tmp_path / "foreign.fmu"
    with zipfile.ZipFile(fmus.path()) as old, zipfile.ZipFile(path, "w") as new:
        for entry in old.infolist():
            new.writestr(entry.filename.replace("linux64", "amiga68k"), old.read(entry))
    with pytest.raises(PlantError, match=r"no binary for x86_64-linux \(it has: .*amiga68k, "):
        FmuPlant(paper, path)
