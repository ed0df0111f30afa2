"""Files that are there whole or not at all, and caches that only their user can write."""

from __future__ import annotations

from rti_storage.cache import user_cache
from rti_storage.files import write_atomically

__all__ = ["user_cache", "write_atomically"]
