"""Turns a failed validation into one line: table, field, error, allowed values."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from difflib import get_close_matches
from operator import index
from typing import Annotated, Any, Literal, TypeVar, get_args

from pydantic import BaseModel, BeforeValidator, ValidationError

Document = TypeVar("Document", bound=BaseModel)

# In place of pydantic's messages, whose words are not TOML's.
_EXPECTED = {
    "tuple_type": "must be a list",
    "dict_type": "must be a table",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
}


def _no_boolean(value: object) -> object:
    if isinstance(value, bool):
        raise ValueError("must be 1")
    return value


SchemaVersion = Annotated[Literal[1], BeforeValidator(_no_boolean)]
"""Version of a document's form; to Python true is 1."""


def assignments(
    texts: Iterable[str],
    option: str,
    form: str,
    error: type[Exception],
) -> Iterator[tuple[str, str]]:
    """Names and values of texts `NAME=VALUE`, as options give them.

    Args:
        texts: what was given, in its order; a value may hold further signs of equality.
        option: that of the command line, `--set` say.
        form: how one is written, `NAME=VALUE` say.
        error: class of the exception that is raised.

    Raises:
        error: a text has no name or no sign of equality.
    """
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not name.strip():
            raise error(f"{option} {text}: write {form}")
        yield name.strip(), value.strip()


def validated(
    model: type[Document],
    document: Any,
    origin: str,
    error: type[Exception],
) -> Document:
    """The document as a model.

    Args:
        model: class of the document.
        document: what is validated.
        origin: what messages call it.
        error: class of the exception that is raised.

    Raises:
        error: in one line that names origin, field and allowed values.
    """
    try:
        return model.model_validate(document)
    except ValidationError as cause:
        first, *others = cause.errors(include_url=False)
        # Of a list whose only entry is wrong pydantic says, too, that it has too few.
        place = first["loc"]
        others = [other for other in others if other["loc"] != place[: len(other["loc"])]]
        complaint = _complaint(dict(first), model)
        # One line: who has mended the first sees the next.
        if others:
            noun = "problem" if len(others) == 1 else "problems"
            complaint += f" ({len(others)} more {noun})"
        raise error(f"{origin}: {complaint}") from None


def whole_number(
    name: str,
    value: Any,
    least: int,
    error: type[Exception],
) -> int:
    """An argument as an integer, NumPy's too.

    Args:
        name: of the argument, for messages.
        value: what was given.
        least: smallest value that is allowed.
        error: class of the exception that is raised.

    Raises:
        error: it is no whole number, or a smaller one.
    """
    try:
        number = index(value)
    except TypeError:
        # An array's text may be pages.
        shown = repr(value)[:60]
        raise error(f"{name} must be a whole number, not {shown}") from None
    # To Python a truth is a whole number.
    if isinstance(value, bool) or number < least:
        raise error(f"{name} must be at least {least}, not {value}")
    return number


def suggestion(word: str, known: Iterable[str]) -> str:
    """` (did you mean 'x'?)` if a known word is close, else nothing.

    Args:
        word: what was given.
        known: words that are allowed.
    """
    close = get_close_matches(word, list(known), n=1, cutoff=0.5)
    if not close:
        return ""
    return f" (did you mean '{close[0]}'?)"


def instead(word: str, known: Iterable[str]) -> str:
    """Text with the words that are known in place of an unknown one, the closest first.

    Args:
        word: what was given.
        known: words that are allowed.
    """
    known = list(known)
    return f"{suggestion(word, known)}; there are {', '.join(known)}"


def _complaint(detail: dict[str, Any], model: type[BaseModel]) -> str:
    """One line of pydantic's detail of a fault."""
    kind = detail["type"]
    if kind == "value_error":
        return str(detail["ctx"]["error"])
    # A union adds the kind that was tried.
    path = [part for part in detail["loc"] if part not in ("float", "bool")]
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
    shown = repr(detail["input"])
    if len(shown) > 60:
        shown = f"{shown[:57]}..."
    return f"{field}: {expected}, not {shown}"


def _dotted(path: list[Any]) -> str:
    text = ""
    for part in path:
        # A key may be any text; a message is one line.
        name = part if str(part).isprintable() else repr(part)
        if isinstance(part, int):
            text += f"[{part}]"
        elif text:
            text += f".{name}"
        else:
            text = str(name)
    return text or "document"


def _fields(model: type[BaseModel], path: list[Any]) -> list[str]:
    """Names that the table at `path` allows."""
    for part in path:
        # An entry of a list of tables.
        if isinstance(part, int):
            continue
        # A file has a field's alias where it has one.
        by_key = {info.alias or name: info for name, info in model.model_fields.items()}
        annotation = by_key[str(part)].annotation
        # The table itself, in a union with None, or in a list of such a union.
        candidates = [annotation]
        for inner in get_args(annotation):
            candidates += [inner, *get_args(inner)]
        for candidate in candidates:
            if isinstance(candidate, type) and issubclass(candidate, BaseModel):
                model = candidate
                break
    return [info.alias or name for name, info in model.model_fields.items()]
