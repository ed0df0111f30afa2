"""Turns a failed validation into one line: table, field, error, allowed values."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from operator import index
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, BeforeValidator, ValidationError

Document = TypeVar("Document", bound=BaseModel)

# In place of pydantic's messages, whose words are not TOML's.
_EXPECTED = {"tuple_type": "must be a list"} | dict.fromkeys(
    ("dict_type", "model_type", "model_attributes_type"), "must be a table"
)


def _no_boolean(value: object) -> object:
    if isinstance(value, bool):
        raise ValueError("must be 1")
    return value


SchemaVersion = Annotated[Literal[1], BeforeValidator(_no_boolean)]
"""Version of a document's form; to Python true is 1."""


def validated(
    model: type[Document], document: Any, origin: str, error: type[Exception]
) -> Document:
    """The document as a model; raises `error` that names its origin, field and allowed values."""
    try:
        return model.model_validate(document)
    except ValidationError as cause:
        first, *others = cause.errors(include_url=False)
        more = f" ({len(others)} more problem{'s' * (len(others) > 1)})" if others else ""
        raise error(f"{origin}: {_complaint(dict(first), model)}{more}") from None


def whole_number(name: str, value: Any, least: int, error: type[Exception]) -> int:
    """An argument as an integer, NumPy's too; raises `error` on another kind or a smaller one."""
    try:
        number = index(value)
    except TypeError:
        raise error(f"{name} must be a whole number, not {f'{value!r}'[:60]}") from None
    if isinstance(value, bool) or number < least:
        raise error(f"{name} must be at least {least}, not {value}")
    return number


def suggestion(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` if a known word is close, else nothing."""
    close = get_close_matches(word, list(known), n=1, cutoff=0.5)
    return f" (did you mean '{close[0]}'?)" if close else ""


def instead(word: str, known: Iterable[str]) -> str:
    """Text with the words that are known in place of an unknown one, the closest first."""
    known = list(known)
    return f"{suggestion(word, known)}; there are {', '.join(known)}"


def _complaint(detail: dict[str, Any], model: type[BaseModel]) -> str:
    kind, given = detail["type"], detail["input"]
    if kind == "value_error":
        return str(detail["ctx"]["error"])
    path = [part for part in detail["loc"] if part not in ("float", "bool")]  # of a union
    field = _dotted(path)
    if kind == "missing":
        return f"{field}: is missing"
    if kind == "extra_forbidden":
        known = _fields(model, path[:-1])
        return (
            f"{field}: unknown field{suggestion(str(path[-1]), known)}; "
            f"allowed are {', '.join(known)}"
        )
    expected = _EXPECTED.get(kind) or str(detail["msg"]).replace("Input should be", "must be", 1)
    shown = repr(given)
    return f"{field}: {expected}, not {shown if len(shown) <= 60 else shown[:57] + '...'}"


def _dotted(path: list[Any]) -> str:
    text = ""
    for part in path:
        # A key may be any text; a message is one line.
        name = part if str(part).isprintable() else repr(part)
        text += f"[{part}]" if isinstance(part, int) else f".{name}" if text else str(name)
    return text or "document"


def _fields(model: type[BaseModel], path: list[Any]) -> list[str]:
    """Names that the table at `path` allows."""
    for part in path:
        if isinstance(part, int):  # an entry of a list of tables
            continue
        annotation = model.model_fields[str(part)].annotation
        inner = get_args(annotation)
        candidates = (annotation, *inner, *(deeper for each in inner for deeper in get_args(each)))
        model = next(
            option
            for option in candidates
            if isinstance(option, type) and issubclass(option, BaseModel)
        )
    return [info.alias or name for name, info in model.model_fields.items()]
