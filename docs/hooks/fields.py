"""Hyperparameters on the reference pages: a field's description is its docstring there."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from griffe import Class, Docstring, Extension
from pydantic import BaseModel


class Fields(Extension):
    """Takes description and default of the fields of pydantic models that have no docstring."""

    def on_class(self, *, cls: Class, **_: Any) -> None:
        """Document the class's own fields."""
        model = getattr(import_module(cls.module.path), cls.name, None)
        if not (isinstance(model, type) and issubclass(model, BaseModel)):
            return
        for name, field in model.model_fields.items():
            if field.description and (own := cls.members.get(name)) is not None:
                own.docstring = Docstring(field.description, parent=own)
                own.value = repr(field.default)
