"""Saved states of a plant, in the FMU's memory and as bytes."""

from __future__ import annotations

import ctypes
import struct
from typing import Protocol

from cosim.errors import PlantError
from cosim.plant.instance import Instance

_HEADER = struct.Struct("<8sq32s")
_MAGIC = b"cosimfs1"


class Owner(Protocol):
    """The plant that a snapshot is of."""

    def recycle(self, handle: ctypes.c_void_p) -> None:
        """Take back a dropped snapshot's memory."""


class Snapshot:
    """A saved state of one plant; `FmuPlant.restore` goes back to it any number of times.

    Its memory belongs to the FMU and is handed to a later snapshot when this one is dropped.
    """

    __slots__ = ("_plant", "handle", "k")

    def __init__(self, plant: Owner, handle: ctypes.c_void_p, k: int) -> None:
        self._plant = plant
        self.handle = handle
        self.k = k

    def belongs_to(self, plant: Owner) -> bool:
        """Whether the plant made this snapshot."""
        return self._plant is plant

    def __del__(self) -> None:
        """Give the memory back to the plant."""
        self._plant.recycle(self.handle)


class Memory:
    """The FMU's memory of saved states, used again: what an FMU allocates leaks until freed."""

    def __init__(self) -> None:
        self._all: list[ctypes.c_void_p] = []
        self._free: list[ctypes.c_void_p] = []

    def take(self) -> ctypes.c_void_p:
        """A dropped snapshot's memory, or none yet: the FMU allocates what it needs."""
        if self._free:
            return self._free.pop()
        handle = ctypes.c_void_p()
        self._all.append(handle)
        return handle

    def give(self, handle: ctypes.c_void_p) -> None:
        """Keep a dropped snapshot's memory for the next one."""
        self._free.append(handle)

    def free(self, fmi: Instance) -> None:
        """Hand all of it back to the FMU."""
        for handle in self._all:
            fmi.free(handle)


def packed(k: int, sha256: str, state: bytes) -> bytes:
    """Return an FMU's serialised state with its sample number and the FMU's hash before it."""
    return _HEADER.pack(_MAGIC, k, bytes.fromhex(sha256)) + state


def unpacked(data: bytes, sha256: str) -> tuple[int, bytes]:
    """Return sample number and FMU state; raises PlantError unless `packed` made them so."""
    if len(data) < _HEADER.size or data[:8] != _MAGIC:
        raise PlantError("these bytes are not a serialised plant state")
    _, k, digest = _HEADER.unpack_from(data)
    if digest.hex() != sha256:
        raise PlantError(f"this state was serialised from another FMU ({digest.hex()[:16]}…)")
    if k < 0:
        raise PlantError("these bytes are not a serialised plant state")
    return k, data[_HEADER.size :]
