"""The extended Kalman filter in compiled code, which works in the memory of the one in Python."""

from __future__ import annotations

import ctypes

from controllers.export.core import ENGINE_SOURCES
from controllers.export.filter import filter_sources
from controllers.filter_model import FilterModel
from controllers.functions import library
from cosim.core.protocols import Vector


class FilterEngine:
    """Predicts and corrects in the memories of a filter and of its derivatives.

    Args:
        path: The library.
        memory: The filter's.
        slopes: The derivatives'; None where the filter does not differentiate.
    """

    def __init__(self, path: str, memory: Vector, slopes: Vector | None) -> None:
        calls = ctypes.CDLL(path)
        # ctypes takes every result for an int, which is too short for a size.
        calls.filter_sizes.restype = ctypes.c_size_t
        # Python and the C structs share the memory: a size that differs would be a wrong number.
        message = "Python and C lay memory out unlike"
        assert calls.filter_sizes(0) == memory.nbytes, message
        assert slopes is None or calls.filter_sizes(1) == slopes.nbytes, message
        # A pointer keeps nothing alive.
        self._arrays = (memory, slopes)
        self._predict = calls.filter_predict
        self._correct = calls.filter_correct
        self._memory = ctypes.c_void_p(memory.ctypes.data)
        self._slopes = None if slopes is None else ctypes.c_void_p(slopes.ctypes.data)

    @classmethod
    def compile(
        cls, model: FilterModel, memory: Vector, slopes: Vector | None
    ) -> FilterEngine | None:
        """Compiled engine of a filter, or None without a compiler.

        Args:
            model: What the filter computes with.
            memory: The filter's.
            slopes: The derivatives'; None where the filter does not differentiate.
        """
        sources = filter_sources(model, differentiates=True)
        sources["filter_engine.c"] = (ENGINE_SOURCES / "filter_engine.c").read_bytes()
        path = library(sources)
        return None if path is None else cls(str(path), memory, slopes)

    def predict(self) -> bool:
        """Go on by a sample under the memory's action; whether what is predicted is finite."""
        return bool(self._predict(self._memory, self._slopes))

    def correct(self) -> bool:
        """Take up the memory's readings; False, and nothing is done, where one is infinite."""
        return bool(self._correct(self._memory, self._slopes))
