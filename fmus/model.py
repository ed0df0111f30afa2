"""A model: its table of variables, and its texts in an FMU: descriptions and C header."""

from __future__ import annotations

import csv
import hashlib
import html
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from fractions import Fraction
from functools import cache, cached_property, partial
from importlib.metadata import version as version_of
from math import isinf
from os.path import commonprefix
from pathlib import Path
from typing import Any, Literal, NamedTuple

FmiVersion = Literal[2, 3]


class Kind(StrEnum):
    """Role of a variable."""

    INDEPENDENT = "independent"
    INPUT = "input"
    STATE = "state"
    DERIVATIVE = "derivative"
    OUTPUT = "output"
    FIXED = "fixed parameter"
    TUNABLE = "tunable parameter"


class Type(StrEnum):
    """Value type.

    FMI 2.0 alone has `SEED_HIGH`, the upper half of the seed, and `LAW_NUMBER`, the law as an
    integer for tools that do not set enumerations (libcosim ignores them).
    """

    REAL = "Real"
    BOOLEAN = "Boolean"
    LAW = "Law"
    SEED = "Seed"
    SEED_HIGH = "SeedHigh"
    LAW_NUMBER = "LawNumber"


@dataclass(frozen=True)
class Variable:
    """One variable: its unit, range and the variables that its equation names (`uses`)."""

    name: str
    kind: Kind
    type: Type = Type.REAL
    unit: str = ""
    start: float | None = None
    min: float | None = None
    max: float | None = None
    nominal: float | None = None
    description: str = ""
    uses: tuple[str, ...] = ()

    @property
    def settable(self) -> bool:
        """Whether an importer gives its value (parameters and inputs)."""
        given = (Kind.INPUT, Kind.FIXED, Kind.TUNABLE)
        return self.kind in given

    @property
    def identifier(self) -> str:
        """The name as a C identifier: ``der(X2)`` becomes ``der_X2``, ``p.x[0]`` ``p_x_0_``."""
        return re.sub(r"\W", "_", self.name.replace(")", ""))


def read_variables(file: Path) -> list[Variable]:
    """The table of variables in a CSV file with a column for each field of `Variable`."""
    variables = []
    with file.open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            numbers = {}
            for key in ("start", "min", "max", "nominal"):
                # An empty cell is a number that the variable does not have.
                numbers[key] = float(row[key]) if row[key] else None
            variable = Variable(
                row["name"],
                Kind[row["kind"]],
                Type[row["type"]],
                row["unit"],
                **numbers,
                description=row["description"],
                uses=tuple(row["uses"].split()),
            )
            variables.append(variable)
    return variables


@dataclass(frozen=True)
class Unit:
    """A unit and its SI form: value_SI = factor · value + offset, with exponents of base units.

    Where the SI form is not known `exponents` are None.
    """

    name: str
    factor: float = 1.0
    offset: float = 0.0
    exponents: Mapping[str, int] | None = field(default_factory=dict)

    def si(self) -> dict[str, object]:
        """The attributes of FMI's BaseUnit."""
        attributes: dict[str, object] = dict(self.exponents or {})
        # What is None is not written: it is FMI's default.
        attributes["factor"] = None if self.factor == 1.0 else self.factor
        attributes["offset"] = None if self.offset == 0.0 else self.offset
        return attributes


_UNITS_FILE = Path(__file__).parent / "resources" / "units.csv"
_UNITS_TEXT = _UNITS_FILE.read_text(encoding="utf-8")
_SIMPLE = {row["name"]: row for row in csv.DictReader(_UNITS_TEXT.splitlines())}
# Several factors below the line stand in brackets: `cm3/(V.s)`.
_QUOTIENT = re.compile(r"[^/()]*(/(\([^/()]*\)|[^/().]*))*")
_POWER = re.compile(r"(1|[A-Za-z%]+)(-?\d+)?")
_EXPONENT = re.compile(r"([A-Za-z]+)(-?\d+)")
_BASE = ("kg", "m", "s", "A", "K", "mol", "cd", "rad")


@cache
def unit(name: str) -> Unit:
    """The unit `name` with its SI form, as far as it is made of those in `resources/units.csv`.

    They are written as in FMI: ``kg/min``, ``1/s``, ``cm3/(V.s)``. An offset has only a unit that
    stands alone.
    """
    unknown = Unit(name, exponents=None)
    # A unit that is not understood is written by its name alone, which FMI allows.
    if not _QUOTIENT.fullmatch(name):
        return unknown
    # Fractions: a product of floats would depend on the order of its terms.
    factor = Fraction(1)
    exponents = dict.fromkeys(_BASE, 0)
    for position, part in enumerate(name.split("/")):
        # The numerator first; it may be empty.
        sign = -1 if position else 1
        symbols = []
        if part:
            symbols = part.strip("()").split(".")
        for symbol in symbols:
            match = _POWER.fullmatch(symbol)
            if match is None:
                return unknown
            simple_name, digits = match.groups()
            if simple_name not in _SIMPLE:
                return unknown
            simple = _SIMPLE[simple_name]
            power = sign * int(digits or 1)
            factor *= Fraction(simple["factor"]) ** power
            for base, exponent in _EXPONENT.findall(simple["exponents"]):
                exponents[base] += power * int(exponent)
    offset = Fraction(0)
    # A rate in degC/min is that in K/min.
    if name in _SIMPLE:
        offset = Fraction(_SIMPLE[name]["offset"])
    occurring = {}
    for base, exponent in exponents.items():
        # FMI's default is 0.
        if exponent != 0:
            occurring[base] = exponent
    return Unit(name, float(factor), float(offset), occurring)


@dataclass(frozen=True, eq=False)
class FmuModel:
    """A model: its name, C identifier, table of variables, interfaces and C sources.

    A variable's value reference is its position in the table.

    Attributes:
        name: of the model.
        identifier: the same in C.
        description: in words.
        variables: the table.
        step_size: of the default experiment, of 100 steps, in s.
        model_exchange: whether it offers that beside co-simulation.
        derivatives: whether it has directional ones.
        sampled: whether it acts at the multiples of `step_size` alone: its outputs are discrete,
            and no communication step may pass over a sample. Its reals ``NAME[…]`` are one array
            NAME in FMI 3.0.
        terminal: variables of FMI 3.0's terminal ``loop``, which a plant and its controller connect
            by their names.
        units: order of the variables' units where it shall not be the table's own.
        sources: its own C headers by file name; a sampled model's ``core.h`` defines the functions
            that ``sampled_sources/model_state.h`` lists, with arrays in the order of the table.
        origin: tells in generated C where it comes from.
    """

    name: str
    identifier: str
    description: str
    variables: tuple[Variable, ...]
    step_size: float
    model_exchange: bool = False
    derivatives: bool = False
    sampled: bool = False
    terminal: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    sources: Mapping[str, bytes] = field(default_factory=dict)
    origin: str = ""

    @cached_property
    def arrays(self) -> dict[str, list[Variable]]:
        """The elements of FMI 3.0's arrays, in table order, by the arrays' names."""
        arrays: dict[str, list[Variable]] = defaultdict(list)
        if not self.sampled:
            return arrays
        for variable in self.variables:
            name, bracket, _ = variable.name.partition("[")
            if bracket and variable.type is Type.REAL:
                arrays[name].append(variable)
        # A look at a name that is no array must not make one.
        return dict(arrays)

    @cached_property
    def by_name(self) -> dict[str, Variable]:
        """Each variable by its name, an array's first element by the array's, too."""
        variables = {}
        for name, elements in self.arrays.items():
            variables[name] = elements[0]
        for variable in self.variables:
            variables[variable.name] = variable
        return variables

    def value_reference(self, name: str) -> int:
        """The value reference of variable `name`; KeyError when there is none."""
        return self.variables.index(self.by_name[name])

    def names(self, *kinds: Kind) -> list[str]:
        """The names of the variables of these kinds, in table order."""
        return [variable.name for variable in self.variables if variable.kind in kinds]

    def exported(self, version: FmiVersion) -> list[Variable]:
        """The variables of the table that FMI `version` shows.

        FMI 3.0 has the whole seed in one variable, and an array in place of its elements; FMI 2.0
        shows no time: FMI Library refuses it.
        """
        if version == 2:
            return [v for v in self.variables if v.kind is not Kind.INDEPENDENT]
        # By the table's variable what is shown in its place, in the order of the table.
        shown = {}
        for variable in self.variables:
            if variable.type not in (Type.SEED_HIGH, Type.LAW_NUMBER):
                shown[variable] = variable
        for name, elements in self.arrays.items():
            # The array says what is common to its elements, and in which order they are.
            descriptions = [element.description for element in elements]
            common = commonprefix(descriptions).rstrip(", ")  # noqa: RUF071
            indices = [element.name.removeprefix(name) for element in elements]
            order = " ".join(indices)
            first, *others = elements
            shown[first] = replace(first, name=name, description=f"{common}: {order}")
            for element in others:
                del shown[element]
        return list(shown.values())


@cache
def closure(name: str, model: FmuModel) -> frozenset[str]:
    """All variables that a calculated variable depends on, states not resolved further.

    Args:
        name: of the variable.
        model: the table that it is in.
    """
    names: set[str] = set()
    # A state is known at every instant; what it depends on acts through its derivative.
    for used in model.by_name[name].uses:
        names.add(used)
        if model.by_name[used].kind in (Kind.OUTPUT, Kind.DERIVATIVE):
            names |= closure(used, model)
    return frozenset(names)


def continuous_dependencies(name: str, model: FmuModel) -> tuple[str, ...]:
    """States and inputs that a variable depends on during the simulation, in table order.

    Args:
        name: of the variable.
        model: the table that it is in.
    """
    if model.by_name[name].kind is Kind.STATE:
        return (name,)
    known = closure(name, model)
    possible = model.names(Kind.STATE, Kind.INPUT)
    return tuple(other for other in possible if other in known)


def initial_dependencies(name: str, model: FmuModel) -> tuple[str, ...]:
    """Parameters and inputs that a variable depends on at initialisation, in table order.

    Args:
        name: of the variable.
        model: the table that it is in.
    """
    direct = closure(name, model)
    names = set(direct)
    for known in direct:
        # A state depends on its start parameter.
        if model.by_name[known].kind is Kind.STATE:
            names |= closure(known, model)
    dependencies = []
    for variable in model.variables:
        if variable.settable and variable.name in names:
            dependencies.append(variable.name)
    return tuple(dependencies)


TEMPLATES = Path(__file__).parent / "templates"

Attributes = Mapping[str, object]


def render(template: str, **values: object) -> str:
    """The text that a template of `TEMPLATES` makes of `values`.

    Filters: `xml` and `html` escape a text; `attributes` writes a mapping as XML attributes, but
    for those that are None; `number` writes a number.
    """
    text: str = _template(template).render(values)
    return text


@cache
def _template(name: str) -> Any:
    import jinja2  # noqa: PLC0415 (whoever steps an FMU builds none)

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        keep_trailing_newline=True,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["attributes"] = _attributes
    environment.filters["html"] = html.escape
    environment.filters["number"] = _number_text
    environment.filters["xml"] = _xml
    return environment.get_template(name)


def _xml(text: str) -> str:
    escaped = html.escape(text, quote=False)
    # In an attribute a reader takes a plain end of line for a blank.
    return escaped.replace('"', "&quot;").replace("\n", "&#10;")


def _attributes(values: Attributes) -> str:
    """XML attributes, but for those that are None."""
    text = ""
    for key, value in values.items():
        if value is not None:
            text += f' {key}="{_xml(str(value))}"'
    return text


def _number_text(value: float) -> str:
    """Shortest text that reads back to `value`; integers without a fraction."""
    return repr(float(value)).removesuffix(".0")


_CAUSALITY = {
    Kind.INDEPENDENT: ("independent", "continuous", None),
    Kind.INPUT: ("input", "continuous", None),
    Kind.STATE: ("output", "continuous", "calculated"),
    Kind.DERIVATIVE: ("local", "continuous", "calculated"),
    Kind.OUTPUT: ("output", "continuous", "calculated"),
    Kind.FIXED: ("parameter", "fixed", "exact"),
    Kind.TUNABLE: ("parameter", "tunable", "exact"),
}


def model_description(
    version: FmiVersion,
    token: str,
    model: FmuModel,
) -> str:
    """The text of modelDescription.xml.

    Args:
        version: major version of FMI.
        token: GUID of FMI 2.0 or instantiation token of FMI 3.0.
        model: the model that is described.
    """
    if model.units:
        unit_names = list(model.units)
    else:
        # Once, in the order of the table.
        unit_names = []
        for variable in model.variables:
            if variable.unit and variable.unit not in unit_names:
                unit_names.append(variable.unit)
    variables = []
    for variable in model.exported(version):
        common = _common_attributes(variable, model)
        element, attributes = _type(version, variable, model)
        variables.append((common, element, attributes))
    tool = "rti-cosim"
    # The shipped files stay the same from one version to the next.
    if model.sampled:
        tool = f"rti-cosim {version_of('rti-cosim')}"
    return render(
        "modelDescription.xml",
        version=version,
        token=token,
        model=model,
        tool=tool,
        types={variable.type.name for variable in model.variables},
        units=[unit(name) for name in unit_names],
        variables=variables,
        structure=_structure(version, model),
    )


def terminals(model: FmuModel, icon: bool = False) -> dict[str, bytes]:
    """FMI 3.0's terminalsAndIcons.xml by its path, if the model has a terminal.

    Args:
        model: the model.
        icon: whether the archive holds an icon, too.
    """
    if not model.terminal:
        return {}
    text = render("terminalsAndIcons.xml", model=model, icon=icon)
    return {"terminalsAndIcons/terminalsAndIcons.xml": text.encode()}


def build_description(version: FmiVersion, model: FmuModel) -> str:
    """The text of sources/buildDescription.xml: one C99 source file, linked with libm.

    Args:
        version: major version of FMI.
        model: names the library.
    """
    return render("buildDescription.xml", version=version, model=model)


def _common_attributes(variable: Variable, model: FmuModel) -> Attributes:
    """The attributes that every variable has in FMI 2.0 and 3.0."""
    causality, variability, initial = _CAUSALITY[variable.kind]
    # It changes at the samples alone.
    if variable.kind is Kind.OUTPUT and model.sampled:
        variability = "discrete"
    # FMI allows continuous variables of real types alone.
    if variable.kind is Kind.INPUT and variable.type is not Type.REAL:
        variability = "discrete"
    return {
        "name": variable.name,
        "valueReference": model.value_reference(variable.name),
        "description": variable.description,
        "causality": causality,
        "variability": variability,
        "initial": initial,
    }


def _type(
    version: FmiVersion,
    variable: Variable,
    model: FmuModel,
) -> tuple[str, Attributes]:
    """The element of a variable's type and its attributes."""
    match variable.type:
        case Type.BOOLEAN:
            return "Boolean", {"start": "true" if variable.start else "false"}
        case Type.LAW:
            return "Enumeration", {"declaredType": "Law", "min": 1, "max": 2, "start": 1}
        case Type.LAW_NUMBER:
            return "Integer", {"min": 0, "max": 2, "start": 0}
        case Type.SEED | Type.SEED_HIGH if version == 3:
            return "UInt64", {"min": 0, "max": 2**64 - 1, "start": 0}
        case Type.SEED | Type.SEED_HIGH:
            return "Integer", {"min": -(2**31), "max": 2**31 - 1, "start": 0}
        case _:
            element = "Real" if version == 2 else "Float64"
            return element, _real_attributes(version, variable, model)


def _real_attributes(
    version: FmiVersion,
    variable: Variable,
    model: FmuModel,
) -> Attributes:
    # In the order in which the description has them.
    attributes: dict[str, object] = {"unit": variable.unit or None}
    for key in ("min", "max", "nominal", "start"):
        value = getattr(variable, key)
        # FMI forbids a nominal value of zero.
        if value is None or (key == "nominal" and value == 0.0):
            continue
        # What is not bounded has no attribute: XML's own INF is not for every importer.
        if isinf(value):
            continue
        attributes[key] = float(value)
    # An array has one attribute with the starts of all its elements.
    if variable.start is not None and variable.name in model.arrays:
        starts = []
        for element in model.arrays[variable.name]:
            start = float(element.start or 0.0)
            starts.append(str(start))
        attributes["start"] = " ".join(starts)
    if variable.kind is Kind.DERIVATIVE:
        state = variable.name.removeprefix("der(").removesuffix(")")
        number_of = _numbering(version, model)
        attributes["derivative"] = number_of(state)
    calculated = variable.kind in (Kind.STATE, Kind.OUTPUT)
    if version == 3 and calculated and not model.sampled:
        attributes["intermediateUpdate"] = "true"
    return attributes


def _numbering(version: FmiVersion, model: FmuModel) -> Callable[[str], int]:
    """Reference to a variable in the description: FMI 2.0 by its position, from 1."""
    if version == 3:
        return model.value_reference
    names = [variable.name for variable in model.exported(2)]
    # FMI 2.0 counts what the description shows, not the table.
    return lambda name: names.index(name) + 1


class _Unknowns(NamedTuple):
    """A group of FMI's ModelStructure.

    Attributes:
        element: FMI 3.0's name of one unknown.
        group: FMI 2.0's name of the element around them.
        kinds: of the variables in it.
        dependencies_of: names that a variable of a model depends on.
    """

    element: str
    group: str
    kinds: tuple[Kind, ...]
    dependencies_of: Callable[[str, FmuModel], tuple[str, ...]]


_UNKNOWNS = (
    _Unknowns(
        "Output",
        "Outputs",
        (Kind.STATE, Kind.OUTPUT),
        continuous_dependencies,
    ),
    _Unknowns(
        "ContinuousStateDerivative",
        "Derivatives",
        (Kind.DERIVATIVE,),
        continuous_dependencies,
    ),
    _Unknowns(
        "InitialUnknown",
        "InitialUnknowns",
        (Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT),
        initial_dependencies,
    ),
)


def _structure(
    version: FmiVersion,
    model: FmuModel,
) -> list[tuple[str, str, list[Attributes]]]:
    """The unknowns of ModelStructure by group, with their dependencies."""
    number_of = _numbering(version, model)
    reference = "index" if version == 2 else "valueReference"
    # By the names of the table: FMI 3.0 shows an array in place of its first element.
    shown = set()
    for variable in model.exported(version):
        first_element = model.by_name[variable.name]
        shown.add(first_element.name)
    structure = []
    for group in _UNKNOWNS:
        unknowns: list[Attributes] = []
        for name in model.names(*group.kinds):
            if name not in shown:
                continue
            numbers = []
            for other in group.dependencies_of(name, model):
                if other in shown:
                    numbers.append(str(number_of(other)))
            # The states depend on themselves or on their start with constant factor 1.
            is_state = model.by_name[name].kind is Kind.STATE
            kind = "constant" if is_state else "dependent"
            unknown = {
                reference: number_of(name),
                "dependencies": " ".join(numbers),
                "dependenciesKind": " ".join([kind] * len(numbers)),
            }
            unknowns.append(unknown)
        if unknowns:
            structure.append((group.element, group.group, unknowns))
    return structure


def c_header(token: str, model: FmuModel) -> str:
    """The text of variables.h: value references, types, starts, ranges, and the model's token.

    The C of a sampled model checks every variable against a range. With the header FMI's functions
    are called ``identifier_fmi2…`` and so on, so that several models link into one program; whoever
    builds a library defines FMI2_ or FMI3_OVERRIDE_FUNCTION_PREFIX.

    Args:
        token: GUID or instantiation token.
        model: the model.
    """
    names = "\n".join(variable.name for variable in model.variables)
    digest = hashlib.sha256(names.encode())
    most = sys.float_info.max if model.sampled else 0.0
    return render(
        "variables.h",
        token=token,
        model=model,
        origin=model.origin or f"the table of {model.name}",
        # A serialised state of another table is refused.
        layout=digest.hexdigest()[:16],
        types=list(Type.__members__),
        kinds=list(Kind.__members__),
        numbers=partial(_start_and_range, most),
    )


def _start_and_range(most: float, variable: Variable) -> tuple[float, ...]:
    """Start, range and nominal value as the C has them; without a range it is −`most` to `most`."""
    low = variable.min
    high = variable.max
    nominal = variable.nominal
    if low is None:
        low = -most
    if high is None:
        high = most
    if nominal is None:
        nominal = 1.0
    # In C a word of the seed has 32 bits and no sign.
    if variable.type in (Type.SEED, Type.SEED_HIGH):
        low = 0.0
        high = 2.0**32 - 1
    # C's tables have no infinity.
    largest = sys.float_info.max
    low = max(low, -largest)
    high = min(high, largest)
    numbers = (variable.start, low, high, nominal)
    # Nothing and −0.0 are written as 0.0.
    return tuple(float(number or 0.0) for number in numbers)
