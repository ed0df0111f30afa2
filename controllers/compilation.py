"""CasADi functions compiled by the machine's own C compiler, once, and kept in the user's cache."""

from __future__ import annotations

import hashlib
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import casadi as ca

from controllers.buffered import BufferedFunction
from controllers.code_generation import c_source
from controllers.errors import ControllerError
from controllers.shared_library import FLAGS, Build, find, find_compiler, lock_of
from cosim.cache import sweep, trusted_folder

KIND = "compiled"
SWITCH = "COSIM_COMPILE"
CHOICES = ("auto", "never", "now")
INTERPRETED, COMPILED = "interpreted", "compiled"
LOOK, WORTH, POLL = 50, 2000, 200
"""Calls after which a stored library is looked for, one is compiled, and each look at its end."""


def switch() -> str:
    """`auto`, `never` or `now`, as the environment's COSIM_COMPILE says.

    Raises ControllerError on another word.
    """
    chosen = os.environ.get(SWITCH) or CHOICES[0]
    if chosen not in CHOICES:
        raise ControllerError(f"{SWITCH} is '{chosen}'; it must be {', '.join(CHOICES)} or not set")
    return chosen


def description() -> str:
    """Which of compiler and interpreter a long run uses here, in a few words."""
    if switch() == "never":
        return f"{INTERPRETED} ({SWITCH}=never)"
    compiler = find_compiler(os.environ.get("CC"))
    if compiler is None:
        return f"{INTERPRETED} (no C compiler found)"
    return f"{COMPILED} by {compiler.path} {' '.join(FLAGS)}, kept in {trusted_folder(KIND)}"


class Compilation:
    """Functions that are interpreted at first and compiled once enough calls show that it pays.

    `count()` is called once a sample. Early on, a library that some earlier run has left is taken
    up; after `WORTH` samples the compiler is started, and its library taken up when it is there,
    while the samples go on. The bytes of all results are the same throughout. Without compiler, and
    where it fails, the interpreter stays. The environment's COSIM_COMPILE may say `never`, or
    `now` to have it done, and waited for, at once.
    """

    def __init__(self, functions: Sequence[BufferedFunction]) -> None:
        self._functions = functions
        self.mode = INTERPRETED
        """Whether the functions are `interpreted` or `compiled` now."""
        self._calls, self._next = 0, LOOK
        self._build: Build | None = None
        self._source = ""
        chosen = switch()
        if chosen == "never":
            self._next = sys.maxsize
        elif chosen == "now":
            self.finish()

    def count(self) -> None:
        """Count a sample."""
        self._calls += 1
        if self._calls >= self._next:
            self._advance()

    def postpone(self) -> None:
        """Change nothing before `finish`, however many samples are counted."""
        self._next = sys.maxsize

    def finish(self) -> str:
        """Do at once, and wait for, what `count` would do in time; returns `mode`.

        With COSIM_COMPILE=never that is nothing.
        """
        wanted = self.mode == INTERPRETED and switch() != "never"
        if wanted and self._prepare() and not self._take(self._stored()):
            if self._build is None:
                self._start(wait=True)
            if self._build is not None:
                self._build.done(wait=True)
                self._finish_build()
        self._next = sys.maxsize
        return self.mode

    def _advance(self) -> None:
        if self._build is not None:
            self._next = self._calls + POLL
            if self._build.done():
                self._finish_build()
        elif not self._prepare() or self._take(self._stored()):
            self._next = sys.maxsize
        elif self._calls < WORTH:
            self._next = WORTH
        else:
            self._next = self._calls + POLL
            try:
                self._start()
            except OSError:
                self._next = sys.maxsize

    def _prepare(self) -> bool:
        """Write the source and name the library; False where there is no compiler."""
        compiler = find_compiler(os.environ.get("CC"))
        if compiler is None:
            return False
        if not self._source:
            self._source = c_source([function.function for function in self._functions])
            content = "\0".join((self._source, compiler.identity, *FLAGS))
            self._name = hashlib.sha256(content.encode()).hexdigest()[:32]
            self._compiler, self._folder = compiler, trusted_folder(KIND)
        return True

    def _start(self, *, wait: bool = False) -> None:
        """Start the compiler unless another process is at it, or, after a wait, has been."""
        lock = lock_of(self._name, self._folder, wait=wait)
        if lock is None:
            return
        if self._take(self._stored()):
            lock.release()
            self._next = sys.maxsize
            return
        self._build = Build(self._compiler, self._source, self._name, self._folder, lock)

    def _finish_build(self) -> None:
        assert self._build is not None
        path, self._build = self._build.publish(), None
        self._take(path)
        self._next = sys.maxsize
        with suppress(OSError):
            sweep(self._folder)

    def _stored(self) -> Path | None:
        return find(self._name, self._folder)

    def _take(self, path: Path | None) -> bool:
        """Put the library's functions in place of the interpreted ones."""
        if path is None:
            return False
        try:
            loaded = [ca.external(f.function.name(), str(path)) for f in self._functions]
        except RuntimeError:  # not a library that this system loads
            return False
        for function, compiled in zip(self._functions, loaded, strict=True):
            function.bind(compiled)
        self.mode = COMPILED
        return True
