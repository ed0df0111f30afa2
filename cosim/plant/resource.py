"""What plants and pools share as context managers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Resource(ABC):
    """A resource that the end of its `with` block closes."""

    @abstractmethod
    def close(self) -> None:
        """Give up what the resource holds."""

    def __enter__(self) -> Self:
        """Return the resource itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close the resource."""
        self.close()
