"""A model's own functions, called with symbols and checked when the model is made."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import casadi as ca
import numpy as np

from controllers.errors import ModelError
from cosim.core.modules import exception_line

REMEDIES = (
    (
        "truth value",
        "it asks whether an expression is true, by if, max, min, and, or: "
        "use casadi.if_else, fmax, fmin, logic_and, logic_or",
    ),
    (
        "'SX' and 'MX'|'MX' and 'SX'",
        "it mixes MX symbols with its arguments, which are SX: use x, u, d and p alone",
    ),
    (
        "[Oo]ut of bounds",
        "it reads an entry that x, u, d or p does not have: they are as long as the model's "
        "quantities",
    ),
    (
        "positional argument|keyword argument",
        "it must take four arguments (x, u, d, p), whether it uses them or not",
    ),
    (
        "must be real number|float\\(\\)|convert .* to .*float|only (length-1|0-dimensional)|"
        "ufunc|loop of",
        "it uses a function of numbers, of math or NumPy, on an expression: use CasADi's",
    ),
)
"""What an exception in a model's function means, by a pattern of its text."""


@dataclass(frozen=True)
class ModelFunction:
    """A function (x, u, d, p) → column of a model, as its user wrote it.

    A call accepts what is a column without doubt, an expression (rows, 1) or a list, tuple or array
    of `rows` scalars, and returns it as a CasADi column. Anything else is a ModelError, whose one
    line names the model, the function, what is wrong and how to mend it.
    """

    function: Callable[..., Any]
    name: str
    model: str
    rows: int

    def __call__(self, x: ca.SX, u: ca.SX, d: ca.SX, p: ca.SX) -> ca.SX:
        """The column (rows, 1) at x, u, d and p, symbols or numbers."""
        try:
            # Copies: what the function writes into its arguments stays its own.
            arguments = [_copy(argument) for argument in (x, u, d, p)]
            result = self.function(*arguments)
            column: Any = _column(result)
        except ModelError:
            raise
        except Exception as error:  # the user's code may raise anything
            raise self.error(_meaning(error)) from error
        if column is None:
            raise self.error(
                f"it returned {_words(result)} in place of {self._wanted()}: {self._remedy()}"
            )
        if column.shape != (self.rows, 1):
            rows, columns = column.shape
            if columns != 1:
                counted = f"a matrix of {rows} rows and {columns} columns"
            elif rows != 1:
                counted = f"{rows} expressions"
            else:
                counted = "1 expression"
            raise self.error(
                f"it returned {counted} in place of {self._wanted()}: {self._remedy()}"
            )
        checked: ca.SX = column
        return checked

    def check(self, symbols: Sequence[ca.SX]) -> None:
        """Call it once with the symbols (x, u, d, p); raises ModelError on what cannot be used."""
        column = self(*symbols)
        if isinstance(column, ca.MX):
            raise self.error(
                "it returned an MX expression: build it of x, u, d and p, which are SX, alone"
            )
        function = ca.Function(
            self.name,
            list(symbols),
            [ca.SX(column)],
            {"allow_free": True},
        )
        free = [str(symbol) for symbol in function.get_free()]
        if free:
            raise self.error(
                f"it depends on {', '.join(free)}, which is no entry of x, u, d or p: "
                "make it a parameter or a disturbance of the model, or give it a number"
            )
        for k in range(function.n_instructions()):
            if function.instruction_id(k) != ca.OP_CONST:
                continue
            constant = function.instruction_constant(k)
            if not isfinite(constant):
                raise self.error(
                    f"it contains the constant {constant}: look for a division by zero, a number "
                    "that is missing, or math.… or float(…) of an expression"
                )

    def error(self, reason: str) -> ModelError:
        """A ModelError about this function."""
        return ModelError(f"model '{self.model}', {self.name}(x, u, d, p): {reason}")

    def _wanted(self) -> str:
        if self.rows == 1:
            return "one expression"
        return f"{self.rows} expressions, one a state"

    def _remedy(self) -> str:
        if self.name == "ode":
            return "return casadi.vertcat(…) with the rate of each state in their order"
        return "return one scalar, the cost of a sample"


def _copy(argument: Any) -> Any:
    if isinstance(argument, ca.SX | ca.MX | ca.DM):
        return argument[:, :]
    return argument


def _column(result: Any) -> Any:
    """What a function returned as a CasADi column; None where it is not one at all."""
    if isinstance(result, ca.SX | ca.MX | ca.DM):
        return result
    if isinstance(result, np.ndarray):
        if result.ndim == 2 and result.shape[1] == 1:
            result = result[:, 0]
        if result.ndim > 1:
            return None
        result = result.tolist()  # a list, or a number
    if isinstance(result, list | tuple):
        return ca.vertcat(*result)
    if isinstance(result, int | float | np.number) and not isinstance(result, bool):
        return ca.SX(float(result))
    return None


def _words(result: Any) -> str:
    if result is None:
        return "None"
    kind = type(result).__name__
    if isinstance(result, np.ndarray):
        return f"{kind} of shape {result.shape}"
    return kind


def _meaning(error: Exception) -> str:
    """What went wrong in a function and how to mend it, where that can be told, in one line."""
    for pattern, remedy in REMEDIES:
        if re.search(pattern, str(error)):
            return f"{remedy} ({_short(error)})"
    return f"it cannot be called with symbols: {_short(error)}"


def _short(error: Exception) -> str:
    """The exception in one line, without CasADi's lists of prototypes."""
    line = exception_line(error)
    words, bracket, place = line.rpartition(" (")
    if len(words) > 160:
        words = f"{words[:157]}…"
    return f"{words}{bracket}{place}"
