"""The evaporator: its table of variables, from which all else is generated, and its FMUs."""

from __future__ import annotations

import hashlib
import json
import uuid
from html import escape
from pathlib import Path
from string import Template

from cosim.files import temporary_folder
from fmus import BuildError, plants
from fmus.build import (
    COMPILER_FLAGS,
    PACKAGE,
    RESOURCES,
    SOURCES,
    WARNINGS,
    Compiler,
    binaries,
    compilers,
    read_archive,
    write_archive,
)
from fmus.description import LICENSE, build_description, c_header, model_description
from fmus.model import LAW_NUMBER, SATURATE, FmiVersion, Kind, Model, Type, Unit, Variable

UNITS = (
    Unit("1"),
    Unit("s", 1.0, 0.0, (("s", 1),)),
    Unit("d", 86400.0, 0.0, (("s", 1),)),
    Unit("1/d", 1 / 86400, 0.0, (("s", -1),)),
    Unit("%", 0.01),
    Unit("%/s", 0.01, 0.0, (("s", -1),)),
    Unit("kg", 1.0, 0.0, (("kg", 1),)),
    Unit("kPa", 1e3, 0.0, (("kg", 1), ("m", -1), ("s", -2))),
    Unit("kPa/s", 1e3, 0.0, (("kg", 1), ("m", -1), ("s", -3))),
    Unit("kg/min", 1 / 60, 0.0, (("kg", 1), ("s", -1))),
    Unit("kg/kPa", 1e-3, 0.0, (("m", 1), ("s", 2))),
    Unit("degC", 1.0, 273.15, (("K", 1),)),
    Unit("K", 1.0, 0.0, (("K", 1),)),
    Unit("K/kPa", 1e-3, 0.0, (("kg", -1), ("m", 1), ("s", 2), ("K", 1))),
    Unit("K/%", 100.0, 0.0, (("K", 1),)),
    Unit("kW", 1e3, 0.0, (("kg", 1), ("m", 2), ("s", -3))),
    Unit("kW/K", 1e3, 0.0, (("kg", 1), ("m", 2), ("s", -3), ("K", -1))),
    Unit("kW.min/kg", 6e4, 0.0, (("m", 2), ("s", -2))),
    Unit("kW.min/(kg.K)", 6e4, 0.0, (("m", 2), ("s", -2), ("K", -1))),
)

DISTURBANCES = ("X1", "F1", "T1", "T200")
STATES = ("X2", "P2")

_SWITCHES = (
    "stochastic",
    "override",
    "law",
    "law_number",
    "seed",
    "seedHigh",
    "sampling_time",
    "time",
)


def _input(name: str, unit: str, start: float, low: float, high: float, text: str) -> Variable:
    return Variable(name, Kind.INPUT, Type.REAL, unit, start, low, high, start, text)


def _tunable(name: str, unit: str, start: float, low: float, high: float, text: str) -> Variable:
    return Variable(name, Kind.TUNABLE, Type.REAL, unit, start, low, high, start, text)


def _output(
    name: str, unit: str, low: float, high: float, nominal: float, text: str, uses: str
) -> Variable:
    return Variable(
        name, Kind.OUTPUT, Type.REAL, unit, None, low, high, nominal, text, tuple(uses.split())
    )


def _disturbance(
    name: str, unit: str, nominal: float, low: float, high: float, text: str
) -> Variable:
    uses = (f"{name}_in", f"{name}_nominal", f"{name}_range", *_SWITCHES)
    return Variable(
        name, Kind.OUTPUT, Type.REAL, unit, None, low, high, nominal, f"realised {text}", uses
    )


def _state(name: str, unit: str, high: float, nominal: float, text: str) -> Variable:
    return Variable(
        name, Kind.STATE, Type.REAL, unit, None, 0.0, high, nominal, text, (f"{name}_start",)
    )


def _range(disturbance: str, unit: str, start: float, high: float) -> Variable:
    text = "half width (uniform) or standard deviation (normal)"
    return _tunable(f"{disturbance}_range", unit, start, 0.0, high, text)


def _start(state: str, unit: str, start: float, high: float, nominal: float) -> Variable:
    return Variable(
        f"{state}_start", Kind.FIXED, Type.REAL, unit, start, 0.0, high, nominal,
        f"{state} at the start",
    )  # fmt: skip


def _derivative(state: str, unit: str, nominal: float, uses: str) -> Variable:
    return Variable(
        f"der({state})", Kind.DERIVATIVE, Type.REAL, unit, None, -1e3, 1e3, nominal,
        f"time derivative of {state}", tuple(uses.split()),
    )  # fmt: skip


def _switch(name: str, kind: Kind, start: bool, text: str) -> Variable:
    return Variable(name, kind, Type.BOOLEAN, "", float(start), 0.0, 1.0, None, text)


def _seed(name: str, type_: Type, text: str) -> Variable:
    return Variable(name, Kind.FIXED, type_, "", 0.0, None, None, None, text)


VARIABLES: tuple[Variable, ...] = (
    Variable("time", Kind.INDEPENDENT, Type.REAL, "s", None, None, None, None, "simulation time"),
    _state("X2", "%", 100.0, 25.0, "product composition"),
    _state("P2", "kPa", 400.0, 50.0, "operating pressure"),
    _derivative("X2", "%/s", 0.01, "F1 X1 F2 X2 M"),
    _derivative("P2", "kPa/s", 0.01, "F4 F5 C"),
    _input("P100", "kPa", 191.71322, 100.0, 400.0, "steam pressure (manipulated)"),
    _input("F200", "kg/min", 215.88844, 100.0, 400.0, "cooling water flow (manipulated)"),
    _input("X1_in", "%", 5.0, 0.0, 50.0, "feed composition, used while override is true"),
    _input("F1_in", "kg/min", 10.0, 0.0, 100.0, "feed flow, used while override is true"),
    _input("T1_in", "degC", 40.0, -100.0, 300.0, "feed temperature, used while override is true"),
    _input("T200_in", "degC", 25.0, -100.0, 300.0,
           "cooling water inlet temperature, used while override is true"),
    _disturbance("X1", "%", 5.0, -200.0, 250.0, "feed composition"),
    _disturbance("F1", "kg/min", 10.0, -400.0, 500.0, "feed flow"),
    _disturbance("T1", "degC", 40.0, -1000.0, 1200.0, "feed temperature"),
    _disturbance("T200", "degC", 25.0, -1000.0, 1200.0, "cooling water inlet temperature"),
    _output("economic_cost", "1", -1e6, 1e6, 6000.0,
            "operating cost rate 10.09 (F2 + F3) + 600 F100 + 0.6 F200", "F2 F3 F100 F200"),
    _output("F2", "kg/min", -1e3, 1e3, 2.0, "product flow", "F1 F4"),
    _output("F4", "kg/min", -1e3, 1e3, 8.0, "vapour flow", "Q100 F1 Cp T2 T1 lambda_"),
    _output("F5", "kg/min", -1e3, 1e3, 8.0, "condensate flow", "Q200 lambda_"),
    _output("F100", "kg/min", -1e3, 1e3, 9.0, "steam flow", "Q100 lambda_s"),
    _output("T2", "degC", -1e3, 1e3, 80.0, "product temperature", "a P2 b X2 c"),
    _output("T3", "degC", -1e3, 1e3, 80.0, "vapour temperature", "d P2 e"),
    _output("T100", "degC", -1e3, 1e3, 120.0, "steam temperature", "f P100 g"),
    _output("UA1", "kW/K", -1e3, 1e3, 10.0, "heat transfer of the heater", "h F1 F3"),
    _output("Q100", "kW", -1e5, 1e5, 350.0, "heater duty", "UA1 T100 T2"),
    _output("Q200", "kW", -1e5, 1e5, 300.0, "condenser duty", "UA2_present T3 T200 Cp F200"),
    _switch("stochastic", Kind.TUNABLE, True, "draw the disturbances; false: the nominal plant"),
    _switch("override", Kind.TUNABLE, False, "take the disturbances from the inputs *_in"),
    Variable("law", Kind.FIXED, Type.LAW, "", 1.0, 1.0, 2.0, None, "law of the disturbances"),
    _seed("seed", Type.SEED, "seed of the disturbances"),
    _seed("seedHigh", Type.SEED_HIGH, "upper 32 bits of the seed (FMI 2.0 Integers have 32)"),
    Variable("sampling_time", Kind.FIXED, Type.REAL, "s", 60.0, 0.01, 86400.0, 60.0,
             "the disturbances are redrawn at its multiples and held in between"),
    _tunable("X1_nominal", "%", 5.0, 0.0, 50.0, "nominal feed composition"),
    _tunable("F1_nominal", "kg/min", 10.0, 0.1, 100.0, "nominal feed flow"),
    _tunable("T1_nominal", "degC", 40.0, 0.0, 200.0, "nominal feed temperature"),
    _tunable("T200_nominal", "degC", 25.0, 0.0, 200.0, "nominal cooling water inlet temperature"),
    _range("X1", "%", 1.0, 20.0),
    _range("F1", "kg/min", 2.0, 40.0),
    _range("T1", "K", 8.0, 100.0),
    _range("T200", "K", 5.0, 100.0),
    _start("X2", "%", 25.0, 100.0, 25.0),
    _start("P2", "kPa", 49.74297, 400.0, 50.0),
    _tunable("a", "K/kPa", 0.5616, 0.0, 10.0, "slope of T2 in P2"),
    _tunable("b", "K/%", 0.3126, 0.0, 10.0, "slope of T2 in X2"),
    _tunable("c", "degC", 48.43, -100.0, 200.0, "offset of T2"),
    _tunable("d", "K/kPa", 0.507, 0.0, 10.0, "slope of T3 in P2"),
    _tunable("e", "degC", 55.0, -100.0, 200.0, "offset of T3"),
    _tunable("f", "K/kPa", 0.1538, 0.0, 10.0, "slope of T100 in P100"),
    _tunable("g", "degC", 90.0, -100.0, 200.0, "offset of T100"),
    _tunable("h", "kW.min/(kg.K)", 0.16, 0.0, 10.0, "heat transfer of the heater per flow"),
    _tunable("M", "kg", 20.0, 1.0, 1e4, "liquid holdup"),
    _tunable("C", "kg/kPa", 4.0, 0.1, 1e4, "vapour holdup per pressure"),
    _tunable("UA2", "kW/K", 6.84, 0.0, 1e3, "heat transfer of the clean condenser"),
    _tunable("Cp", "kW.min/(kg.K)", 0.07, 0.001, 10.0, "heat capacity of liquor and cooling water"),
    _tunable("lambda_", "kW.min/kg", 38.5, 1.0, 1e3, "latent heat of the evaporated water"),
    _tunable("lambda_s", "kW.min/kg", 36.6, 1.0, 1e3, "latent heat of the steam"),
    _tunable("F3", "kg/min", 50.0, 0.0, 1e3, "circulating flow"),
    Variable("fouling_rate", Kind.TUNABLE, Type.REAL, "1/d", 0.0, 0.0, 1e3, 0.1,
             "rate at which the condenser fouls; 0: it does not"),
    _tunable("fouling_floor", "1", 0.7, 0.0, 1.0, "share of UA2 that fouling leaves in the end"),
    _tunable("cleaning_period", "d", 6.0, 0.0, 1e5,
             "the condenser is cleaned at its multiples; 0: never"),
    _output("UA2_present", "kW/K", 0.0, 1e3, 6.84,
            "present heat transfer of the condenser: UA2 while it is clean",
            "UA2 fouling_rate fouling_floor cleaning_period sampling_time time"),
    _switch("saturate", Kind.FIXED, False, SATURATE),
    Variable("law_number", Kind.FIXED, Type.LAW_NUMBER, "", 0.0, 0.0, 2.0, None, LAW_NUMBER),
)  # fmt: skip

EVAPORATOR = Model(
    name="Evaporator",
    identifier="evaporator",
    version="1.0.0",
    description="Stochastic evaporation process, the plant of the RTI co-simulation benchmark",
    variables=VARIABLES,
    units=UNITS,
    stop_time=6000.0,
    step_size=60.0,
    model_exchange=True,
    derivatives=True,
)

BY_NAME = EVAPORATOR.by_name


def documentation_page(version: FmiVersion, build_file: str) -> str:
    """The text of documentation/index.html; `build_file` names the record of the build."""
    template = Template((RESOURCES / "documentation.html").read_text(encoding="utf-8"))
    return template.substitute(
        description=escape(EVAPORATOR.description),
        fmi_version=f"{version}.0",
        model_version=EVAPORATOR.version,
        license=LICENSE,
        diagram=(RESOURCES / "diagram.svg").read_text(encoding="utf-8"),
        rows="\n".join(_row(variable) for variable in EVAPORATOR.exported(version)),
        source=f"fmi{version}.c",
        build_file=build_file,
    )


def _row(variable: Variable) -> str:
    numbers = "".join(
        f'<td class="n">{_number(value)}</td>'
        for value in (variable.start, variable.min, variable.max)
    )
    reference = EVAPORATOR.value_reference(variable.name)
    return (
        f'<tr><td>{variable.name}</td><td class="n">{reference}</td>'
        f"<td>{variable.kind}</td><td>{escape(variable.unit)}</td>{numbers}"
        f"<td>{escape(variable.description)}</td></tr>"
    )


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.10g}"


FILE_NAMES: dict[FmiVersion, str] = {2: "evaporator.fmu", 3: "evaporator_fmi3.fmu"}
HEADER = "variables.h"
BUILD_FILE = "extra/org.rti-cosim/build.json"


def hand_written_sources() -> dict[str, bytes]:
    """File name → bytes of every C source but the generated header."""
    files = sorted(SOURCES.glob("*.[ch]"))
    return {path.name: path.read_bytes() for path in files if path.name != HEADER}


def header(token: str) -> str:
    """The text of `variables.h` with the model's `token`."""
    origin = "from fmus/evaporator.py by `cosim fmu build --in-place`"
    return c_header(token, EVAPORATOR.identifier, VARIABLES, origin)


def model_token() -> str:
    """GUID of FMI 2.0 and instantiation token of FMI 3.0: a digest of all that makes the model."""
    digest = hashlib.sha256()
    descriptions = (model_description(version, "", EVAPORATOR) for version in FILE_NAMES)
    for text in (header(""), *descriptions):
        digest.update(text.encode())
    for name, content in hand_written_sources().items():
        digest.update(name.encode() + b"\0" + content)
    return "{" + str(uuid.UUID(bytes=digest.digest()[:16], version=5)) + "}"


def sources(version: FmiVersion) -> dict[str, bytes]:
    """File name → bytes of the folder `sources/` of the FMU, generated files included."""
    other = "fmi3.c" if version == 2 else "fmi2.c"
    files = {name: data for name, data in hand_written_sources().items() if name != other}
    files[HEADER] = header(model_token()).encode()
    files["buildDescription.xml"] = build_description(version, EVAPORATOR).encode()
    return files


def build_record(with_compilers: list[Compiler]) -> bytes:
    """How the binaries were made (JSON): for each platform the compiler and its flags."""
    record = {
        "compiler_flags": [*COMPILER_FLAGS, *WARNINGS],
        "platforms": {
            compiler.platform.tuple: {
                "compiler": compiler.version,
                "target": compiler.platform.target,
                "linker_flags": list(compiler.linker_flags),
            }
            for compiler in with_compilers
        },
        "model_token": model_token(),
    }
    return (json.dumps(record, indent=2) + "\n").encode()


def contents(version: FmiVersion, every_platform: bool) -> dict[str, bytes]:
    """Every file of the FMU by its path in the archive."""
    icon = (RESOURCES / "icon.png").read_bytes()
    code = sources(version)
    used = compilers(every_platform)
    files = {
        "modelDescription.xml": model_description(version, model_token(), EVAPORATOR).encode(),
        "documentation/index.html": documentation_page(version, BUILD_FILE).encode(),
        "documentation/licenses/license.txt": (RESOURCES / "license.txt").read_bytes(),
        BUILD_FILE: build_record(used),
        **binaries(code, EVAPORATOR.identifier, f"{version}.0", used, WARNINGS),
        **{f"sources/{name}": data for name, data in code.items()},
    }
    if version == 2:
        return files | {"model.png": icon}
    name = "terminalsAndIcons.xml"
    return files | {
        "terminalsAndIcons/icon.png": icon,
        f"terminalsAndIcons/{name}": (RESOURCES / name).read_bytes(),
    }


def build(folder: Path, every_platform: bool = False) -> list[Path]:
    """Build both FMUs into `folder` (made when missing) and return their paths.

    For the platform at hand by the local compiler, or for every one by the extra ``cross``.
    """
    files = {name: contents(v, every_platform) for v, name in FILE_NAMES.items()}
    folder.mkdir(parents=True, exist_ok=True)
    return [write_archive(members, folder / name) for name, members in files.items()]


def differences(built: Path, shipped: Path) -> list[str]:
    """The archive members that differ between two FMU files, or ``["(order or metadata)"]``.

    Empty when the files are equal byte for byte. Raises BuildError when `shipped` is missing.
    """
    if not shipped.is_file():
        raise BuildError(f"{shipped} is missing; reinstall the package")
    if built.read_bytes() == shipped.read_bytes():
        return []
    members = [read_archive(path) for path in (built, shipped)]
    names = sorted(set(members[0]) | set(members[1]))
    differing = [name for name in names if members[0].get(name) != members[1].get(name)]
    return differing or ["(order or metadata)"]


def compare_with_shipped() -> dict[str, list[str]]:
    """Build anew for every platform; file name → `differences` from the shipped file."""
    with temporary_folder("cosim-") as folder:
        built = [*build(folder, every_platform=True), *plants.build(folder, every_platform=True)]
        return {path.name: differences(path, PACKAGE / path.name) for path in built}


def build_in_place() -> list[Path]:
    """Regenerate the C header and the shipped FMUs in the source tree (for developers)."""
    (SOURCES / HEADER).write_text(header(model_token()))
    return [*build(PACKAGE, every_platform=True), *plants.build(PACKAGE, every_platform=True)]
