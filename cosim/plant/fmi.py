"""An FMU: its archive, unpacked and checked, and co-simulation by raw FMI 2.0 and 3.0 calls."""

from __future__ import annotations

import ctypes
import hashlib
import itertools
import multiprocessing
import os
import shutil
import stat
import sys
import tempfile
import threading
import warnings
import zipfile
from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from math import inf, isnan
from pathlib import Path, PurePosixPath
from typing import Any, ClassVar, NamedTuple, NoReturn
from weakref import WeakValueDictionary
from xml.etree import ElementTree

import fmpy
import numpy as np
from fmpy import fmi2, fmi3
from fmpy.fmi1 import _FMU
from fmpy.logging import addLoggerProxy
from fmpy.model_description import read_model_description
from numpy.typing import NDArray

import fmus
from cosim.core.errors import CapabilityError, FmuWarning, PlantError
from cosim.core.files import cache_folder, lock, temporary_folder
from fmus import platforms_of, present

SHIPPED_FMUS = (*fmus.NAMES, *fmus.PLANTS)
DESCRIPTION = "modelDescription.xml"
MAX_ENTRIES = 20_000
MAX_BYTES = 1 << 30


def steps_are_fast(fmu: str) -> bool:
    """Whether the steps of a scenario's FMU are known to be fast, since it is one of ours.

    A step of another's may take a second. No clock is asked: the same command would give other
    digits where it decides how often a solver starts afresh.

    Args:
        fmu: `plant.fmu` of the scenario.
    """
    return fmu in SHIPPED_FMUS


@dataclass(frozen=True)
class UnpackedFmu:
    """An FMU on disk.

    Attributes:
        path: of the archive.
        sha256: of the archive.
        folder: holds its content.
        description: the model description, as fmpy reads it.
        entries: names of the archive's entries.
        flaws: what the description has against FMI's schema and rules, none of which bars a run.
    """

    path: Path
    sha256: str
    folder: Path
    description: Any
    entries: frozenset[str]
    flaws: tuple[str, ...] = ()

    @cached_property
    def variables(self) -> dict[str, Any]:
        """The variables by name."""
        return {variable.name: variable for variable in self.description.modelVariables}

    def variable(self, name: str) -> Any:
        """Variable `name`, or the array whose element ``NAME[…]`` it is; None if there is none."""
        # Many tools write elements as scalars of such a name.
        if name in self.variables:
            return self.variables[name]
        array_name, _, _ = name.partition("[")
        array = self.variables.get(array_name)
        if array is None or not array.shape:
            return None
        return array

    def unit(self, name: str) -> str:
        """Unit of a variable or an array's element; empty where it is not stated."""
        variable = self.variable(name)
        if variable is None:
            return ""
        # The variable's own goes before its type's.
        stated = variable.unit or getattr(variable.declaredType, "unit", None)
        return str(stated or "")

    def range(self, name: str) -> tuple[float, float]:
        """Least and greatest value of a variable, as it or its type states; ±∞ without a bound.

        Tools write numbers for "no bound": 1e60 (Modelica's infinity), DBL_MAX, 1e30, the ends of
        an integer's type. A bound `NO_BOUND` times as large as the variable's scale is none.
        """
        variable = self.variable(name)
        if variable is None:
            return -inf, inf
        start = number(variable.start, 0.0)
        nominal = number(variable.nominal, 0.0)
        scale = max(1.0, abs(start), abs(nominal))
        is_integer = variable.type not in _REALS
        limits = []
        for field, unbounded in (("min", -inf), ("max", inf)):
            stated = getattr(variable, field)
            # The variable's own bound goes before its type's.
            if stated is None:
                stated = getattr(variable.declaredType, field, None)
            value = number(stated, unbounded)
            is_end = is_integer and value in _ENDS
            if is_end or not abs(value) < NO_BOUND * scale:
                value = unbounded
            limits.append(value)
        low, high = limits
        return low, high


NO_BOUND = 1e15
"""Ratio of a bound to a variable's scale from which it is none: a double has 15 digits."""
_REALS = ("Real", "Float64", "Float32")
_ENDS: set[float] = set()
"""Least and greatest integers of each type, with a sign and without."""
for _bits in (8, 16, 32, 64):
    _half = 1 << _bits - 1
    _least = -_half
    _greatest = _half - 1
    _greatest_unsigned = 2 * _half - 1
    _ENDS |= {float(_least), float(_greatest), float(_greatest_unsigned)}


def number(stated: str | float | None, otherwise: float) -> float:
    """A number as a model description states it.

    Args:
        stated: its text.
        otherwise: what it is where the text is missing or no number.
    """
    if stated is None:
        return otherwise
    try:
        value = float(stated)
    except ValueError:
        return otherwise
    # Every comparison with it would be false.
    if isnan(value):
        return otherwise
    return value


_unpacked: dict[tuple[Path, int, int], UnpackedFmu] = {}
_unpack_lock = threading.Lock()


def unpack(fmu: str | Path) -> UnpackedFmu:
    """Unpack an FMU, shipped (by name) or foreign (by path), and read its model description.

    An FMU is native code that runs with the caller's rights, so a foreign one is taken only from
    the very path given. Raises PlantError on a missing, corrupt or suspicious archive.
    """
    path = fmus.path(str(fmu)) if str(fmu) in SHIPPED_FMUS else Path(fmu)
    # A misspelt name of a shipped one, most likely.
    if path.suffix != ".fmu" and len(path.parts) == 1:
        raise PlantError(
            f"unknown FMU '{fmu}'; shipped are {', '.join(SHIPPED_FMUS)}, or give the path of an "
            ".fmu"
        )
    try:
        path = path.resolve()
        if not path.is_file():
            raise PlantError(f"FMU '{path}' does not exist or is not a file")
        status = path.stat()
    # RuntimeError is Python 3.11's of links in a circle.
    except (OSError, RuntimeError) as error:
        why = getattr(error, "strerror", None) or error
        raise PlantError(f"FMU '{path}' cannot be read: {why}") from None
    # A file that has been replaced meanwhile is another FMU.
    key = (path, status.st_mtime_ns, status.st_size)
    with _unpack_lock:
        unpacked = _unpacked.get(key)
        # A user may have emptied the cache while this process runs.
        if unpacked is None or not unpacked.folder.is_dir():
            unpacked = _unpack(path)
            _unpacked[key] = unpacked
        return unpacked


def _unpack(path: Path) -> UnpackedFmu:
    try:
        with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
            _check_entries(path, archive)
            if DESCRIPTION not in archive.namelist():
                raise PlantError(f"'{path}' is not an FMU: it has no {DESCRIPTION}")
            # Of the very file that is unpacked, which may be replaced by another one now.
            stream.seek(0)
            digest = hashlib.file_digest(stream, "sha256")
            sha256 = digest.hexdigest()
            folder = place(archive, sha256)
            entries = frozenset(archive.namelist())
    except PlantError:
        raise
    except OSError as error:
        raise PlantError(f"FMU '{path}' cannot be unpacked: {error}") from None
    # Damaged bytes make zipfile and zlib raise a dozen types, unrelated ones among them.
    except Exception as error:
        raise PlantError(
            f"FMU '{path}' is corrupt or not an FMU ({error}); copy or build it again"
        ) from None
    description, flaws = _describe(path, folder)
    return UnpackedFmu(
        path=path,
        sha256=sha256,
        folder=folder,
        description=description,
        entries=entries,
        flaws=flaws,
    )


def _check_entries(path: Path, archive: zipfile.ZipFile) -> None:
    """Refuse archives with paths outside, links or absurd size.

    Some tools on Windows part folders by backslashes, against the zip format: read as slashes.
    """
    entries = archive.infolist()
    if len(entries) > MAX_ENTRIES:
        raise PlantError(f"FMU '{path}' is refused: more than {MAX_ENTRIES} entries")
    # A few bytes may be packed that fill a disk.
    n_bytes = sum(entry.file_size for entry in entries)
    if n_bytes > MAX_BYTES:
        raise PlantError(f"FMU '{path}' is refused: unpacks to more than {MAX_BYTES >> 20} MiB")
    for entry in entries:
        entry.filename = entry.filename.replace("\\", "/")
        original = entry.orig_filename
        name = PurePosixPath(original.replace("\\", "/"))
        # zipfile cuts a name at a null byte; a colon is a drive on Windows.
        has_evil_sign = ":" in original or "\0" in original
        if name.is_absolute() or ".." in name.parts or has_evil_sign:
            raise PlantError(
                f"FMU '{path}' is refused: entry {original!r} leads outside its folder"
            )
        # The upper half of the attributes is Unix's mode.
        mode = entry.external_attr >> 16
        if stat.S_ISLNK(mode):
            raise PlantError(f"FMU '{path}' is refused: entry '{name}' is a link")
    # zipfile looks a name up here, and had the backslashes.
    archive.NameToInfo = {entry.filename: entry for entry in entries}


def _describe(path: Path, folder: Path) -> tuple[Any, tuple[str, ...]]:
    """The model description, and what it has against FMI's rules; a warning names those, once.

    A description that can be read in spite of its flaws is read. Raises PlantError where it cannot,
    or where a plant cannot be made of it.
    """
    flaws: tuple[str, ...] = ()
    try:
        description = read_model_description(str(folder))
    # fmpy's ValidationError, its bare Exception, and lxml's errors on text that is not XML.
    except Exception as error:
        problems = getattr(error, "problems", [error])
        lines = []
        for problem in problems:
            # One line each: an error of lxml has several.
            words = str(problem).split()
            lines.append(" ".join(words))
        flaws = tuple(lines)
        description = _describe_leniently(path, folder, flaws)
    if description.fmiVersion[:2] not in ("2.", "3."):
        raise PlantError(f"FMU '{path}' is FMI {description.fmiVersion}; 2.0 and 3.0 are supported")
    return description, flaws


def _describe_leniently(
    path: Path,
    folder: Path,
    flaws: tuple[str, ...],
) -> Any:
    """The description of an FMU that failed the validation, with a warning that names the flaws.

    Raises PlantError where it cannot be read, or lacks what a run needs.
    """
    what_is_wrong = flaws[0]
    if len(flaws) > 1:
        what_is_wrong += f" ({len(flaws) - 1} more)"
    try:
        # By the file's own path, sources/buildDescription.xml is left alone.
        description = read_model_description(str(folder / DESCRIPTION), validate=False)
        obstacle = _obstacle(description)
    except Exception:
        obstacle = what_is_wrong
    if obstacle:
        raise PlantError(f"FMU '{path}' has an invalid model description: {obstacle}")
    # A worker process need not repeat it.
    if multiprocessing.parent_process() is None:
        warnings.warn(
            f"FMU '{path.name}' is used although its model description is flawed: {what_is_wrong}; "
            "`cosim fmu check` lists what it found",
            FmuWarning,
            stacklevel=2,
        )
    return description


def _obstacle(description: Any) -> str:
    """Reasons why a description that failed its validation cannot run; empty if none."""
    interface = description.coSimulation
    if not isinstance(description.guid, str):
        return "it has no guid (FMI 3.0: instantiationToken)"
    if interface is not None and not isinstance(interface.modelIdentifier, str):
        return "its co-simulation has no modelIdentifier"
    places: dict[str, tuple[int, str]] = {}
    for variable in description.modelVariables:
        name = variable.name
        place = (variable.valueReference, variable.type)
        # The same one twice does no harm: either gives the same number.
        if name in places and places[name] != place:
            return f"two variables are called '{name}'"
        places[name] = place
    return ""


def place(archive: zipfile.ZipFile, sha256: str) -> Path:
    """Folder with the archive's content, byte for byte; unpacked unless it is there already.

    It lies in a `cosim.core.files.cache_folder`. The URI of that path has no escapes: many FMUs do
    not read them in the URI of their resources.

    Args:
        archive: the FMU.
        sha256: of its bytes, which names the folder.

    Raises:
        OSError: the archive cannot be unpacked; zipfile raises more types.
    """
    cache = cache_folder("fmus", plain=True)
    folder = cache / sha256
    if _holds(folder, archive):
        return folder
    # Workers of a study come here at the same time.
    with lock(cache / f"{sha256}.lock", 60):
        if not _holds(folder, archive):
            # A process that runs from a damaged folder keeps its open files.
            shutil.rmtree(folder, ignore_errors=True)
            with temporary_folder(".partial-", cache) as partial:
                archive.extractall(partial)
                partial.rename(folder)
    return folder


def _holds(folder: Path, archive: zipfile.ZipFile) -> bool:
    """Whether every file of the archive is in the folder with the very same bytes."""
    # Unpacking leaves the last of entries with one name.
    entries = {entry.filename: entry for entry in archive.infolist() if not entry.is_dir()}
    try:
        for name, entry in entries.items():
            path = folder / name
            # A link may lead to a file that somebody changes later.
            if path.is_symlink():
                return False
            if path.read_bytes() != archive.read(entry):
                return False
    except OSError:
        return False
    return True


# FMI 2.0's names are for x86, but exporters on ARM use them as well.
_FALLBACKS = {"aarch64-linux": "linux64", "aarch64-darwin": "darwin64"}


def library_path(fmu: UnpackedFmu) -> Path:
    """Path of the library to load; raises PlantError if it is missing.

    `modelIdentifier` must be a C identifier, the library an entry of the archive, and made for
    this platform by its own first bytes.
    """
    identifier = str(fmu.description.coSimulation.modelIdentifier)
    # It becomes part of a path.
    if not (identifier.isascii() and identifier.isidentifier()):
        raise PlantError(
            f"FMU '{fmu.path}' is refused: modelIdentifier {identifier!r} is not a C identifier"
        )
    platform = present()
    version = str(fmu.description.fmiVersion)
    folders = [platform.folder(version)]
    if version.startswith("2") and platform.tuple in _FALLBACKS:
        folders.append(_FALLBACKS[platform.tuple])
    reasons = []
    for folder in folders:
        entry = f"binaries/{folder}/{identifier}{fmpy.sharedLibraryExtension}"
        if entry not in fmu.entries:
            reasons += _instead(fmu, folder, entry)
            continue
        path = fmu.folder / entry
        made_for = platforms_of(path.read_bytes())
        if platform.tuple in made_for:
            return path
        what = "not a shared library"
        if made_for:
            what = f"made for {' and '.join(made_for)}"
        reasons.append(f"its '{entry}' is {what}")
    why = "; ".join(reasons)
    if not why:
        why = f"it has: {', '.join(_filled_platforms(fmu)) or 'none'}"
    raise PlantError(
        f"FMU '{fmu.path}' has no binary for {platform.tuple} ({why}); build one from its sources, "
        "the shipped FMU's by `cosim fmu build --out DIR` with a C compiler, and name that file"
    )


def _filled_platforms(fmu: UnpackedFmu) -> list[str]:
    """Folders of platforms that the archive has any file for, sorted."""
    folders = set()
    for name in fmu.entries:
        parts = name.split("/")
        is_file = len(parts) > 2 and not name.endswith("/")
        if parts[0] == "binaries" and is_file:
            folders.add(parts[1])
    return sorted(folders)


def _instead(
    fmu: UnpackedFmu,
    folder: str,
    entry: str,
) -> list[str]:
    """Remarks on a platform's folder without its library; empty without a folder."""
    prefix = f"binaries/{folder}/"
    library = entry.removeprefix(prefix)
    inside = sorted(name for name in fmu.entries if name.startswith(prefix))
    if not inside:
        return []
    names = [name.removeprefix(prefix) for name in inside if not name.endswith("/")]
    if not names:
        return [f"its '{prefix}' is empty"]
    # A few suffice: it may hold a tool's whole runtime.
    return [f"its '{prefix}' has {', '.join(names[:5])} and no {library}"]


WARNING = 1
DISCARD = 2
FATAL = 4
"""Values of FMI's status, the same in both versions."""
_STATUS_WORDS = {
    2: "discard",
    3: "error",
    4: "fatal",
    5: "pending",
}

_alive: Counter[str] = Counter()


class Place(NamedTuple):
    """Address of a number in an FMU.

    Attributes:
        reference: value reference of its variable.
        type: FMI's type.
        element: of an array, which one, row by row.
        starts: values that all elements start from.
        structural: whether it is a structural parameter (FMI 3.0), set in configuration mode.
    """

    reference: int
    type: str
    element: int = 0
    starts: tuple[float, ...] = (0.0,)
    structural: bool = False


class _VariableCall(NamedTuple):
    """The call that sets or gets one variable: its name, its arguments, and their buffer."""

    name: str
    arguments: tuple[Any, ...]
    values: Any


class Order(IntEnum):
    """When a step reads the outputs; the numbers are those of the controllers' `fmu.h`.

    FMI 2.0.5 (p. 109) forbids to get after a set without a step in between, and FMI 3.0 says that
    such a get returns what it returned before the set. `SET_GET_STEP` is therefore for those FMUs
    alone that were seen to answer it.
    """

    SET_GET_STEP = 0
    """After the inputs are set and before the step, for outputs that follow the inputs at once."""
    GET_SET_STEP = 1
    """Before the inputs are set, for outputs of state, time or noise alone; allowed everywhere."""
    SET_STEP_GET = 2
    """After the step, for outputs that the step computes; allowed everywhere."""


class Reading(NamedTuple):
    """When the outputs are read: in one order, but for those of numbers `late`, after the step."""

    order: Order
    late: tuple[int, ...] = ()


class Experiment(NamedTuple):
    """Parameters of the simulation for an FMU's start; None is not passed."""

    start_time: float = 0.0
    """Time of the first sample in s."""
    stop_time: float | None = None
    """Time in s beyond which no step goes."""
    tolerance: float | None = None
    """Relative tolerance of the FMU's own solver."""


Intermediate = Callable[[float, NDArray[np.float64]], None]
"""Called with the time since the reset [s] and the states (n,) at each internal step of an FMU."""


def _as(buffer: Any, value: float) -> float:
    """A number as a buffer of a C type takes it: an integer is the nearest one."""
    if buffer._type_ in (ctypes.c_double, ctypes.c_float):
        return value
    return round(value)


class Native(ctypes.Structure):
    """An instance for compiled code; the C struct is `Plant` of the controllers' `fmu.h`."""

    _fields_: ClassVar[list[tuple[str, Any]]] = [
        ("version", ctypes.c_int),
        ("set", ctypes.c_void_p),
        ("get", ctypes.c_void_p),
        ("step", ctypes.c_void_p),
        ("component", ctypes.c_void_p),
        ("inputs", ctypes.c_void_p),
        ("outputs", ctypes.c_void_p),
        ("states", ctypes.c_void_p),
        ("n_inputs", ctypes.c_size_t),
        ("n_outputs", ctypes.c_size_t),
        ("n_states", ctypes.c_size_t),
        ("input", ctypes.c_void_p),
        ("output", ctypes.c_void_p),
        ("state", ctypes.c_void_p),
        ("start_time", ctypes.c_double),
        ("step_size", ctypes.c_double),
        ("order", ctypes.c_int),
        ("no_return", ctypes.c_int),
    ]


NOT_FINITE_STATUS = 5
"""Fault of a compiled loop: an output or state is not finite; lower numbers: a call of FMI."""


class _LoadedByPath(_FMU):  # type: ignore[misc]
    """The base of fmpy's instances, without its change of the working directory of all threads.

    The library's folder is searched for those that it needs: by its own run path, and on Windows
    because it is loaded by a full path.
    """

    def __init__(
        self,
        guid: str,
        modelIdentifier: str,
        unzipDirectory: str,
        libraryPath: str,
        instanceName: str | None = None,
    ) -> None:
        self.guid = guid
        self.modelIdentifier = modelIdentifier
        self.unzipDirectory = unzipDirectory
        self.instanceName = instanceName or modelIdentifier
        self.fmiCallLogger = None
        self.requireFunctions = True
        self._functions: dict[str, Any] = {}
        self.component = None
        self.callbacks = None
        self.dll = ctypes.cdll.LoadLibrary(libraryPath)
        self._loadFunctions()


# fmpy reads the version of FMI from the name of the class.
class FMU2ByPath(fmi2.FMU2Slave, _LoadedByPath):  # type: ignore[misc]
    """fmpy's FMI 2.0 instance."""


class FMU3ByPath(fmi3.FMU3Slave, _LoadedByPath):  # type: ignore[misc]
    """fmpy's FMI 3.0 instance."""


@contextmanager
def _copy_of(library: Path) -> Iterator[Path]:
    """A copy of a library beside it, which is loaded as another one; deleted after the block."""
    handle, name = tempfile.mkstemp(library.suffix, f".{library.stem}-", library.parent)
    os.close(handle)
    try:
        # Beside it, where its run path leads to the libraries that it needs.
        yield Path(shutil.copyfile(library, name))
    finally:
        # Windows keeps a file that is loaded.
        with suppress(OSError):
            Path(name).unlink()


def _why_not_loaded(
    words: str,
    library: str,
    name: str,
) -> str:
    """Reason why an existing library cannot be loaded; `words` are the system's."""
    missing, _, rest = words.partition(": cannot open shared object file: No such file")
    if rest and missing != library:
        return (
            f"does not load: its '{name}' needs the library '{missing}', which this machine does "
            "not have; install that"
        )
    return f"does not load: its '{name}' is there, but {words}"


class Instance(ABC):
    """One co-simulation instance, called through raw function pointers and fixed buffers.

    The pointers carry no argument types: ctypes then passes the ready-made C objects through,
    at half the cost of a checked call.

    Args:
        fmu: the file.
        exchanged: places of inputs, outputs and states.
        starts: places and start values.
        step_size: communication step in s.
        reading: when a step reads the outputs.
        experiment: start time, stop time, tolerance.
        intermediate: is called after each internal step (FMI 3.0); None: nobody is.

    Attributes:
        inputs, outputs, states: buffers of what is exchanged.
        outputs_view, states_view: NumPy's views of the same memory.
        messages: latest words of the FMU's log.
        fatal: whether a call has ended in a fatal error.
        drivable: whether compiled code can exchange all values.
    """

    prefix: ClassVar[str]
    real: ClassVar[str]
    setters: ClassVar[dict[str, tuple[str, Any]]]
    """By the type of a variable that can be set, the setter's name and the type of its values."""
    _state: ClassVar[str]
    """FMI's name of a saved state."""
    _deserialise: ClassVar[str]

    def __init__(
        self,
        fmu: UnpackedFmu,
        exchanged: tuple[Sequence[Place], Sequence[Place], Sequence[Place]],
        starts: Sequence[tuple[Place, float]],
        step_size: float,
        reading: Reading,
        experiment: Experiment,
        intermediate: Intermediate | None,
    ) -> None:
        self.fmu = fmu
        self.messages: deque[str] = deque(maxlen=8)
        self.fatal = False
        self._interface = fmu.description.coSimulation
        self._intermediate = intermediate
        self._places = exchanged
        inputs, outputs, states = exchanged
        if self._interface.canBeInstantiatedOnlyOncePerProcess and _alive[fmu.sha256]:
            raise CapabilityError(
                f"FMU '{fmu.path}' can be instantiated only once per process; close the other plant"
            )
        self._slave = self._load()
        # Counted once it is there: what could not be loaded bars no other.
        _alive[fmu.sha256] += 1
        self._component = ctypes.c_void_p(self._slave.component)
        self._functions: dict[str, Any] = {}
        # Compiled code has one order of calls for all outputs, and converts nothing.
        all_real = all(self._all_real(places) for places in exchanged)
        self.drivable = all_real and not reading.late
        self.experiment = experiment
        self._order = reading.order
        self._step_size = ctypes.c_double(step_size)
        self.no_return: Any = ctypes.c_int(1)
        """Whether no snapshot may take the FMU back to before its present time: an FMU may have to
        hold on to its past for that (noSetFMUStatePriorToCurrentPoint).
        """
        self._time = ctypes.c_double(0.0)
        self.inputs, self._set_inputs = self._exchange(inputs, "Set")
        self.outputs, self._get_outputs = self._exchange(outputs, "Get")
        self.states, self._get_states = self._exchange(states, "Get")
        self.outputs_view: NDArray[np.float64] = np.frombuffer(memoryview(self.outputs))
        self.states_view: NDArray[np.float64] = np.frombuffer(memoryview(self.states))
        self._do_step = self._function("DoStep")
        # Bound once for all steps.
        self._first, self._second, self._third = self._calls_of_a_step(reading)
        self._to_start = self._calls_to_start()
        self._start_places = [place for place, _ in starts]
        # Sizes of arrays come first, in a mode of their own (FMI 3.0).
        structure = [start for start in starts if start[0].structural]
        self._set_structure: Callable[[], None] | None = None
        if structure:
            structure_places, structure_values = zip(*structure, strict=True)
            self._set_structure = self.writer(structure_places, structure_values)
        others = [start for start in starts if not start[0].structural]
        places = [place for place, _ in others]
        self._starts, self._set_starts = self._exchange(places, "Set")
        self._starts[:] = [value for _, value in others]
        self._start_of = {}
        for i, place in enumerate(places):
            # FMI 2 counts value references anew for each type.
            key = (place.reference, place.type, place.element)
            self._start_of[key] = i

    @abstractmethod
    def _instantiate(self, **where: Any) -> Any:
        """An fmpy instance that logs to `messages`; `where`: constructor arguments."""

    @cached_property
    @abstractmethod
    def _step_arguments(self) -> tuple[Any, ...]:
        """The arguments of a step, the instance first."""

    @abstractmethod
    def _calls_to_start(self) -> tuple[tuple[str, tuple[Any, ...]], ...]:
        """The calls that initialise, with their arguments after the instance."""

    @abstractmethod
    def _arguments(self, references: Sequence[int], values: Any) -> tuple[Any, ...]:
        """The arguments of a call that sets or gets variables, the instance first."""

    def _load(self) -> Any:
        library = str(library_path(self.fmu).resolve())
        if self._interface.canBeInstantiatedOnlyOncePerProcess:
            # Its memory is static and keeps what an earlier instance left: a copy has its own.
            with _copy_of(Path(library)) as copy:
                return self._load_library(str(copy))
        return self._load_library(library)

    def _load_library(self, library: str) -> Any:
        try:
            return self._instantiate(
                guid=self.fmu.description.guid,
                modelIdentifier=self._interface.modelIdentifier,
                unzipDirectory=str(self.fmu.folder),
                libraryPath=library,
            )
        except OSError as error:
            name = library_path(self.fmu).name
            what = _why_not_loaded(str(error), library, name)
        # fmpy raises bare Exception when the library does not instantiate.
        except Exception as error:
            what = f"cannot be instantiated: {error}"
        # The likeliest reason, whatever the system's words.
        if self._interface.needsExecutionTool:
            what += "; it needs the tool that made it (needsExecutionTool)"
        raise PlantError(f"FMU '{self.fmu.path}' {what}{self._log()}")

    def _function(self, name: str) -> Any:
        """A function pointer of our own, free of the argument types that fmpy attaches."""
        if name not in self._functions:
            pointer = self._slave.dll[self.prefix + name]
            pointer.restype = ctypes.c_int
            self._functions[name] = pointer
        return self._functions[name]

    def _call(self, name: str, *arguments: Any) -> None:
        """Call a function of FMI; raises PlantError where it fails."""
        status = self._function(name)(*arguments)
        if status and status != WARNING:
            self.fail(name, status)

    def initialise(self, started: bool) -> None:
        """Reset (if started before), write the start values, initialise and read the states."""
        if started:
            self._call("Reset", self._component)
        if self._set_structure is not None:
            self._call("EnterConfigurationMode", self._component)
            self._set_structure()
            self._call("ExitConfigurationMode", self._component)
        if self._starts:
            self._set_starts()
        for name, arguments in self._to_start:
            self._call(name, self._component, *arguments)
        self._get_states()

    def advance(self, time: float) -> None:
        """Write the inputs, step from `time` [s] on, read the states after it.

        The outputs are read before or after the step, as the instance was told.
        """
        self._time.value = time
        self._first()
        self._second()
        status = self._do_step(*self._step_arguments)
        if status and status != WARNING:
            self.fail("DoStep", status)
        self._third()

    def write_inputs(self, values: Sequence[float]) -> None:
        """Set the inputs, one number of each; for a probe, which takes a step in its parts."""
        self.inputs[:] = values
        self._set_inputs()

    def read_outputs(self) -> list[float]:
        """Read the outputs as they are now."""
        self._get_outputs()
        return list(self.outputs)

    def take_step(self, time: float, size: float) -> list[float]:
        """Step, and nothing else.

        Args:
            time: from which, in s.
            size: how far, in s.

        Returns:
            The states after it.
        """
        self._time.value = time
        self._step_size.value = size
        status = self._do_step(*self._step_arguments)
        if status and status != WARNING:
            self.fail("DoStep", status)
        self._get_states()
        return list(self.states)

    def read_starts(self) -> list[float]:
        """The start values as the FMU has them after it was initialised, in the order given."""
        values, read = self._exchange(self._start_places, "Get")
        read()
        return list(values)

    def _calls_of_a_step(self, reading: Reading) -> tuple[Callable[[], None], ...]:
        """Calls before the step, first and second, and after it."""
        set_inputs = self._set_inputs
        get_outputs = self._get_outputs
        get_states = self._get_states
        if reading.order is Order.SET_STEP_GET:

            def get_all() -> None:
                get_outputs()
                get_states()

            return set_inputs, _nothing, get_all
        before = (set_inputs, get_outputs)
        if reading.order is Order.GET_SET_STEP:
            before = (get_outputs, set_inputs)
        if not reading.late:
            return *before, get_states
        late = reading.late
        outputs = self.outputs
        _, output_places, _ = self._places
        late_places = [output_places[i] for i in late]
        values, get_late = self._exchange(late_places, "Get")

        # All outputs were read before the step: the late ones are replaced.
        def get_late_and_states() -> None:
            get_late()
            for i, value in zip(late, values, strict=True):
                outputs[i] = value
            get_states()

        return *before, get_late_and_states

    def _exchange(self, places: Sequence[Place], verb: str) -> tuple[Any, Callable[[], None]]:
        """A buffer for a number of each place, and a function that sets or gets them all."""
        if self._all_real(places):
            return self._exchange_reals(places, verb)
        count = len(places)
        # Not every integer of 64 bits is a double: what is set is a list.
        numbers: Any = [0.0] * count
        if verb == "Get":
            numbers = (ctypes.c_double * count)()
        # The entries of one array are exchanged in one call, with one buffer.
        variables: dict[tuple[int, str], _VariableCall] = {}
        calls = []
        for place in places:
            variable = (place.reference, place.type)
            if variable not in variables:
                suffix, ctype = self.setters[place.type]
                values = (ctype * len(place.starts))()
                # FMI sets an array as a whole: elements that nobody names have their start.
                values[:] = [_as(values, start) for start in place.starts]
                arguments = self._arguments([place.reference], values)
                variables[variable] = _VariableCall(f"{verb}{suffix}", arguments, values)
            calls.append((variables[variable], place.element))

        def set_all() -> None:
            for number, (call, element) in zip(numbers, calls, strict=True):
                call.values[element] = _as(call.values, number)
                self._call(call.name, *call.arguments)

        def get_all() -> None:
            for i, (call, element) in enumerate(calls):
                self._call(call.name, *call.arguments)
                numbers[i] = call.values[element]

        return numbers, set_all if verb == "Set" else get_all

    def _exchange_reals(
        self,
        places: Sequence[Place],
        verb: str,
    ) -> tuple[Any, Callable[[], None]]:
        """`_exchange` of FMI's reals alone: one call for all, without a conversion."""
        buffer = (ctypes.c_double * len(places))()
        name = f"{verb}{self.real}"
        function = self._function(name)
        references = [place.reference for place in places]
        arguments = self._arguments(references, buffer)

        # It runs several times a sample: the status is looked at here, not in another call.
        def exchange() -> None:
            status = function(*arguments)
            if status and status != WARNING:
                self.fail(name, status)

        return buffer, exchange

    def change_start(self, place: Place, value: float) -> None:
        """Replace a start value for the next reset.

        Args:
            place: one among the `starts`.
            value: the new one.
        """
        key = (place.reference, place.type, place.element)
        self._starts[self._start_of[key]] = value

    def writer(self, places: Sequence[Place], values: Sequence[float]) -> Callable[[], None]:
        """A function that writes values between two steps.

        Args:
            places: where.
            values: one for each place.
        """
        buffer, write = self._exchange(places, "Set")
        buffer[:] = values
        return write

    def channel(self, places: Sequence[Place]) -> Callable[[Sequence[float]], None]:
        """A function that writes values of places, one for each, between two steps.

        Args:
            places: where.
        """
        buffer, write = self._exchange(places, "Set")

        def send(values: Sequence[float]) -> None:
            buffer[:] = values
            write()

        return send

    def _all_real(self, places: Iterable[Place]) -> bool:
        """Whether they are FMI's reals, none in an array: compiled code can exchange those."""
        return all(place.type == self.real and len(place.starts) == 1 for place in places)

    @property
    def native(self) -> Native:
        """The instance's functions and buffers for compiled code, which calls them directly.

        It holds for the moment: a snapshot that comes or goes changes `no_return`.
        """
        self._native.no_return = self.no_return.value
        return self._native

    @cached_property
    def _native(self) -> Native:
        def address(item: Any) -> Any:
            return ctypes.cast(item, ctypes.c_void_p)

        buffers = (self.inputs, self.outputs, self.states)
        # Kept: compiled code has only their addresses.
        self._references = []
        for places, buffer in zip(self._places, buffers, strict=True):
            references = [place.reference for place in places]
            _, pointers, *_ = self._arguments(references, buffer)
            self._references.append(pointers)
        inputs, outputs, states = self._references
        return Native(
            version=int(self.prefix[-1]),
            set=address(self._function(f"Set{self.real}")),
            get=address(self._function(f"Get{self.real}")),
            step=address(self._function("DoStep")),
            component=self._component,
            inputs=address(inputs),
            outputs=address(outputs),
            states=address(states),
            n_inputs=len(self.inputs),
            n_outputs=len(self.outputs),
            n_states=len(self.states),
            input=address(self.inputs),
            output=address(self.outputs),
            state=address(self.states),
            start_time=self.experiment.start_time,
            step_size=self._step_size.value,
            order=self._order,
            no_return=self.no_return.value,
        )

    def fail_native(self, fault: int, status: int) -> None:
        """Raise PlantError for the fault of a compiled loop.

        Args:
            fault: number of what failed (`loop.h`).
            status: FMI's.
        """
        names = (f"Set{self.real}", f"Get{self.real}", "DoStep", "DoStep")
        if fault == len(names):
            self.messages.append("the FMU ended the run, or the step early")
            status = DISCARD
        self.fail(names[fault - 1], status)

    def require_state(self) -> None:
        """Raise CapabilityError unless the FMU declares that its state can be saved and set."""
        self._require("canGetAndSetFMUstate", "save and restore its state")

    def require_serialised_state(self) -> None:
        """Raise CapabilityError unless the FMU declares that a saved state can be serialised."""
        self._require("canSerializeFMUstate", "serialise its state")

    def save(self, handle: ctypes.c_void_p) -> None:
        """Copy the FMU's state into a handle; a non-empty handle's memory is used again."""
        self._call(f"Get{self._state}", self._component, ctypes.byref(handle))

    def load(self, handle: ctypes.c_void_p) -> None:
        """Set the FMU's state from a handle and read the plant's states."""
        self._call(f"Set{self._state}", self._component, handle)
        self._get_states()

    def serialise(self, handle: ctypes.c_void_p) -> bytes:
        """Return a saved state as bytes that any instance of this FMU can read."""
        self.require_serialised_state()
        # The caller allocates, by a size that the FMU says.
        size = ctypes.c_size_t()
        arguments = (self._component, handle)
        self._call(f"Serialized{self._state}Size", *arguments, ctypes.byref(size))
        buffer = ctypes.create_string_buffer(size.value)
        self._call(f"Serialize{self._state}", *arguments, buffer, size)
        return buffer.raw

    def deserialise(self, data: bytes, handle: ctypes.c_void_p) -> None:
        """Fill a handle from bytes.

        Args:
            data: what `serialise` returned.
            handle: is filled.

        Raises:
            PlantError: the FMU refuses them.
        """
        self.require_serialised_state()
        n_bytes = len(data)
        buffer = ctypes.create_string_buffer(data, n_bytes)
        size = ctypes.c_size_t(n_bytes)
        self._call(self._deserialise, self._component, buffer, size, ctypes.byref(handle))

    def _require(self, flag: str, ability: str) -> None:
        if not getattr(self._interface, flag):
            raise CapabilityError(
                f"FMU '{self.fmu.path}' cannot {ability}: its model description lacks {flag}"
            )

    def fail(self, function: str, status: int) -> NoReturn:
        """Raise PlantError for a failed call, with the FMU's log messages.

        Args:
            function: its name without FMI's prefix.
            status: what it returned.
        """
        if status == FATAL:
            self.fatal = True
        label = _STATUS_WORDS.get(status, f"status {status}, which FMI does not have")
        raise PlantError(
            f"FMU '{self.fmu.path.name}': {self.prefix}{function} returned {label}{self._log()}"
        )

    def _log(self) -> str:
        # An FMU may say the same at each of its attempts.
        messages = dict.fromkeys(self.messages)
        text = "; ".join(messages)
        self.messages.clear()
        return f": {text}" if text else ""

    def close(self, handles: Iterable[ctypes.c_void_p]) -> None:
        """Free saved states and the instance; after a fatal error FMI forbids these calls, too.

        The library stays loaded, as fmpy would not leave it: the FMU may have started threads.
        """
        _alive[self.fmu.sha256] -= 1
        if self.fatal:
            return
        for handle in handles:
            # A handle into which nothing was saved is null.
            if handle.value is not None:
                free_state = self._function(f"Free{self._state}")
                free_state(self._component, ctypes.byref(handle))
        # It returns nothing, and so is none of `_function`'s.
        free = self._slave.dll[f"{self.prefix}FreeInstance"]
        free.restype = None
        free(self._component)


def _nothing() -> None:
    """Take the place of a call that is not needed."""


_instance_numbers = itertools.count()
_logs: WeakValueDictionary[bytes, deque[str]] = WeakValueDictionary()


def _log(
    _: Any,
    instance: bytes | None,
    status: int,
    category: bytes | None,
    message: bytes | None,
) -> None:
    """Keep a message for the error that may follow.

    Some FMUs sign it with another name than the instance's, or with none: then each instance that
    lives keeps it.
    """
    text = (message or b"").decode("utf-8", "replace")
    known = _logs.get(instance or b"")
    logs = list(_logs.values()) if known is None else [known]
    for log in logs:
        log.append(text)
    # Nobody is left who could put it into an error.
    if not logs and status > WARNING:
        name = (instance or b"FMU").decode("utf-8", "replace")
        print(f"{name}: {text}", file=sys.stderr)


_logger = fmi2.fmi2CallbackLoggerTYPE(_log)
_callbacks = fmi2.fmi2CallbackFunctions()
_callbacks.allocateMemory = fmi2.fmi2CallbackAllocateMemoryTYPE(fmpy.calloc)
_callbacks.freeMemory = fmi2.fmi2CallbackFreeMemoryTYPE(fmpy.free)


def _claim_logger() -> None:
    """Have the FMUs' messages come to us.

    fmpy's proxy, which formats the variadic message, knows one Python logger per process. Whoever
    simulates by fmpy beside us gives it another one, which is gone when that simulation ends.
    """
    _callbacks.logger = _logger
    addLoggerProxy(ctypes.byref(_callbacks))


def _optional(value: float | None, truth: Any) -> tuple[Any, Any]:
    """FMI's two arguments of a value that may be undefined: whether it is defined, and it."""
    is_defined = truth(value is not None)
    number = ctypes.c_double(0.0 if value is None else value)
    return is_defined, number


class Fmi2Instance(Instance):
    """An FMI 2.0 co-simulation instance."""

    prefix = "fmi2"
    real = "Real"
    setters: ClassVar[dict[str, tuple[str, Any]]] = {
        "Real": ("Real", ctypes.c_double),
        "Integer": ("Integer", ctypes.c_int),
        "Enumeration": ("Integer", ctypes.c_int),
        "Boolean": ("Boolean", ctypes.c_int),
    }
    _state = "FMUstate"
    _deserialise = "DeSerializeFMUstate"

    def _calls_to_start(self) -> tuple[tuple[str, tuple[Any, ...]], ...]:
        start, stop, tolerance = self.experiment
        arguments = (
            *_optional(tolerance, ctypes.c_int),
            ctypes.c_double(start),
            *_optional(stop, ctypes.c_int),
        )
        return (
            ("SetupExperiment", arguments),
            ("EnterInitializationMode", ()),
            ("ExitInitializationMode", ()),
        )

    @cached_property
    def _step_arguments(self) -> tuple[Any, ...]:
        return (self._component, self._time, self._step_size, self.no_return)

    def _instantiate(self, **where: Any) -> Any:
        # A name of its own, by which the log finds the instance (`_log`).
        name = f"cosim-{next(_instance_numbers)}"
        _logs[name.encode()] = self.messages
        slave = FMU2ByPath(instanceName=name, **where)
        _claim_logger()
        slave.instantiate(callbacks=_callbacks, loggingOn=True)
        return slave

    def _arguments(self, references: Sequence[int], values: Any) -> tuple[Any, ...]:
        count = len(references)
        pointers = (ctypes.c_uint * count)(*references)
        return (self._component, pointers, ctypes.c_size_t(count), values)


class Fmi3Instance(Instance):
    """An FMI 3.0 co-simulation instance, without event mode and early return."""

    prefix = "fmi3"
    real = "Float64"
    setters: ClassVar[dict[str, tuple[str, Any]]] = {
        name: (name, getattr(fmi3, f"fmi3{name}"))
        for name in (
            "Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Int64",
            "UInt64", "Boolean",
        )
    } | {"Enumeration": ("Int64", fmi3.fmi3Int64)}  # fmt: skip
    _state = "FMUState"
    _deserialise = "DeserializeFMUState"
    _raised: BaseException | None

    def _calls_to_start(self) -> tuple[tuple[str, tuple[Any, ...]], ...]:
        start, stop, tolerance = self.experiment
        arguments = (
            *_optional(tolerance, ctypes.c_bool),
            ctypes.c_double(start),
            *_optional(stop, ctypes.c_bool),
        )
        return (
            ("EnterInitializationMode", arguments),
            ("ExitInitializationMode", ()),
        )

    @cached_property
    def _step_arguments(self) -> tuple[Any, ...]:
        event = ctypes.c_bool()
        self._terminate = ctypes.c_bool()
        self._early = ctypes.c_bool()
        # Infinite where an FMU does not say how far it came.
        self._last_time = ctypes.c_double(inf)
        self.no_return = ctypes.c_bool(self.no_return.value)
        return (
            self._component,
            self._time,
            self._step_size,
            self.no_return,
            ctypes.byref(event),
            ctypes.byref(self._terminate),
            ctypes.byref(self._early),
            ctypes.byref(self._last_time),
        )

    def _instantiate(self, **where: Any) -> Any:
        messages = self.messages

        def log(
            _: Any,
            status: int,
            category: bytes,
            message: bytes,
        ) -> None:
            messages.append(message.decode("utf-8", "replace"))

        slave = FMU3ByPath(**where)
        slave.instantiate(loggingOn=True, logMessage=log, **self._intermediate_update())
        return slave

    def _intermediate_update(self) -> dict[str, Any]:
        """Arguments that ask for the states at each internal step; {} if the FMU has none."""
        if self._intermediate is None or not self._interface.providesIntermediateUpdate:
            return {}
        # fmpy does not read the attribute, an xs:boolean.
        description = ElementTree.parse(self.fmu.folder / DESCRIPTION)
        offered = set()
        for element in description.iter():
            if element.get("intermediateUpdate") in ("true", "1"):
                offered.add(element.get("valueReference"))
        _, _, state_places = self._places
        references = {place.reference for place in state_places}
        # A part of the states is of no use to who watches.
        for reference in references:
            if str(reference) not in offered:
                return {}
        return {
            "intermediateUpdate": self._update,
            "requiredIntermediateVariables": list(references),
        }

    def _update(self, _: Any, time: float, __: bool, readable: bool, *___: Any) -> None:
        """Tell of the states; the FMU calls it in a step."""
        if not readable or self._raised is not None or self._intermediate is None:
            return
        try:
            self._get_states()
            self._intermediate(time, self.states_view.copy())
        except BaseException as error:
            # Kept until the step returns: ctypes would print and drop it.
            self._raised = error

    def _arguments(self, references: Sequence[int], values: Any) -> tuple[Any, ...]:
        n_references = len(references)
        array = (ctypes.c_uint * n_references)(*references)
        # An array variable has one reference and several values.
        count = ctypes.c_size_t(n_references)
        n_values = ctypes.c_size_t(len(values))
        return (self._component, array, count, values, n_values)

    def advance(self, time: float) -> None:
        """Step as in FMI 2.0; an FMU that ends the step early is an error."""
        self._raised = None
        super().advance(time)
        if self._raised is not None:
            raise self._raised
        self._check_end(time + 0.5 * self._step_size.value)

    def take_step(self, time: float, size: float) -> list[float]:
        """Step as in FMI 2.0; an FMU that ends the step early is an error.

        Args:
            time: from which, in s.
            size: how far, in s.

        Returns:
            The states after it.
        """
        self._raised = None
        states = super().take_step(time, size)
        self._check_end(time + 0.5 * size)
        return states

    def _check_end(self, least: float) -> None:
        """Raise PlantError where a step ended early; `least` [s] is a time that it had to pass."""
        last = self._last_time.value
        ends_run = self._terminate.value
        # Half a step is the least: an FMU's own time may be off by rounding.
        if ends_run or self._early.value or last < least:
            what = "run" if ends_run else "step early"
            self.messages.append(f"the FMU ended the {what}, at {last} s")
            self.fail("DoStep", DISCARD)
