"""What plants and pools share as context managers."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Self


class Resource(ABC):
    """A resource that the end of its `with` block closes."""

    @abstractmethod
    def close(self) -> None:
        """Give up what the resource holds."""

    def __enter__(self) -> Self:
        """Return the resource itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the resource."""
        self.close()
