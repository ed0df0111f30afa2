"""Generate the element ModelStructure: unknowns and what they depend on."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree

from fmus.dependencies import continuous_dependencies, initial_dependencies
from fmus.variables import VARIABLES, FmiVersion, Kind, exported, value_reference


def add_structure(root: ElementTree.Element, version: FmiVersion) -> None:
    """Append ModelStructure to the model description `root`."""
    (_structure2 if version == 2 else _structure3)(root)


def index(name: str) -> int:
    """Position of a variable in the model description of FMI 2.0, from 1."""
    return [v.name for v in exported(2)].index(name) + 1


def _names(*kinds: Kind) -> list[str]:
    return [v.name for v in VARIABLES if v.kind in kinds]


_UNKNOWNS = (
    ("Output", "Outputs", (Kind.STATE, Kind.OUTPUT), False),
    ("ContinuousStateDerivative", "Derivatives", (Kind.DERIVATIVE,), False),
    ("InitialUnknown", "InitialUnknowns", (Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT), True),
)


def _kinds_text(name: str, dependencies: Iterable[str]) -> str:
    """The states depend on themselves or on their start with constant factor 1."""
    is_state = name in _names(Kind.STATE)
    return " ".join("constant" if is_state else "dependent" for _ in dependencies)


def _structure2(root: ElementTree.Element) -> None:
    structure = ElementTree.SubElement(root, "ModelStructure")
    for _, tag, kinds, initial in _UNKNOWNS:
        group = ElementTree.SubElement(structure, tag)
        for name in _names(*kinds):
            names = initial_dependencies(name) if initial else continuous_dependencies(name)
            ElementTree.SubElement(
                group,
                "Unknown",
                index=str(index(name)),
                dependencies=" ".join(str(index(n)) for n in names),
                dependenciesKind=_kinds_text(name, names),
            )


def _structure3(root: ElementTree.Element) -> None:
    structure = ElementTree.SubElement(root, "ModelStructure")
    shown = {v.name for v in exported(3)}
    for tag, _, kinds, initial in _UNKNOWNS:
        for name in _names(*kinds):
            names = initial_dependencies(name) if initial else continuous_dependencies(name)
            names = tuple(n for n in names if n in shown)
            ElementTree.SubElement(
                structure,
                tag,
                valueReference=str(value_reference(name)),
                dependencies=" ".join(str(value_reference(n)) for n in names),
                dependenciesKind=_kinds_text(name, names),
            )
