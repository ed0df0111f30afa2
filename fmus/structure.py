"""Generate the element ModelStructure: unknowns and what they depend on."""

from __future__ import annotations

from collections.abc import Iterable
from xml.etree import ElementTree

from fmus.dependencies import continuous_dependencies, initial_dependencies
from fmus.model import FmiVersion, Kind, Model


def add_structure(root: ElementTree.Element, version: FmiVersion, model: Model) -> None:
    """Append ModelStructure to the model description `root`."""
    (_structure2 if version == 2 else _structure3)(root, model)


def index(name: str, model: Model) -> int:
    """Position of a variable in the model description of FMI 2.0, from 1."""
    return [v.name for v in model.exported(2)].index(name) + 1


_UNKNOWNS = (
    ("Output", "Outputs", (Kind.STATE, Kind.OUTPUT), False),
    ("ContinuousStateDerivative", "Derivatives", (Kind.DERIVATIVE,), False),
    ("InitialUnknown", "InitialUnknowns", (Kind.STATE, Kind.DERIVATIVE, Kind.OUTPUT), True),
)


def _dependencies(name: str, initial: bool, model: Model) -> tuple[str, ...]:
    return (initial_dependencies if initial else continuous_dependencies)(name, model)


def _kinds_text(name: str, dependencies: Iterable[str], model: Model) -> str:
    """The states depend on themselves or on their start with constant factor 1."""
    is_state = model.by_name[name].kind is Kind.STATE
    return " ".join("constant" if is_state else "dependent" for _ in dependencies)


def _structure2(root: ElementTree.Element, model: Model) -> None:
    structure = ElementTree.SubElement(root, "ModelStructure")
    for _, tag, kinds, initial in _UNKNOWNS:
        unknowns = model.names(*kinds)
        if not unknowns:
            continue
        group = ElementTree.SubElement(structure, tag)
        for name in unknowns:
            names = _dependencies(name, initial, model)
            ElementTree.SubElement(
                group,
                "Unknown",
                index=str(index(name, model)),
                dependencies=" ".join(str(index(n, model)) for n in names),
                dependenciesKind=_kinds_text(name, names, model),
            )


def _structure3(root: ElementTree.Element, model: Model) -> None:
    structure = ElementTree.SubElement(root, "ModelStructure")
    shown = {v.name for v in model.exported(3)}
    for tag, _, kinds, initial in _UNKNOWNS:
        for name in model.names(*kinds):
            names = _dependencies(name, initial, model)
            names = tuple(n for n in names if n in shown)
            ElementTree.SubElement(
                structure,
                tag,
                valueReference=str(model.value_reference(name)),
                dependencies=" ".join(str(model.value_reference(n)) for n in names),
                dependenciesKind=_kinds_text(name, names, model),
            )
