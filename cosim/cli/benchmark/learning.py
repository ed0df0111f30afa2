"""Times a sample of each learning rule, all included, beside the interpreter and other versions."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from controllers.compilation import COMPILED, SWITCH
from cosim.cli.benchmark.figures import figure
from cosim.errors import CosimError

REPETITIONS = 20
"""Short turns and many: the clock rate of a shared machine changes within seconds."""
SETTLING = 1000
"""Samples before the clock starts: warm-up of the rule, caches, and the naive θ's worst QPs."""
EXPLORATION = {"exploration_probability": 0.3, "exploration_deviation": [10.0]}
INTERPRETER = "interpreter"


class Case(NamedTuple):
    """A rule that is timed: its `name` in the table, the `algorithm` and its `settings`.

    `shared`: versions before the recommended rules have it too, and do the same work in it.
    """

    name: str
    algorithm: str
    settings: Mapping[str, Any]
    shared: bool


CASES = (
    Case("q-learning", "q-learning", EXPLORATION, True),
    Case("actor-critic", "actor-critic", EXPLORATION, True),
    Case("batch-q-learning", "batch-q-learning", EXPLORATION, True),
    Case("search", "search", {}, False),
)


def measure(
    scenario: str,
    samples: int,
    progress: Callable[[int], None],
    *,
    against: Path | None = None,
    cases: Sequence[Case] = CASES,
    repetitions: int = REPETITIONS,
    settling: int = SETTLING,
) -> dict[str, Any]:
    """Time a sample of each rule in µs of CPU time, FMU included, and its references.

    Each rule learns in a process of its own with compiled functions, in one with interpreted ones
    and, where it is `shared`, in one with the packages of the folder `against`, another version's
    sources; they take `samples` samples each in turn, `repetitions` times, after `settling`.
    `parts` are µs of a further, instrumented stretch. Raises CosimError where a process fails.
    """
    if against is not None and not (against / "learning" / "__init__.py").is_file():
        raise CosimError(f"--against: '{against}' does not hold the package learning")
    if Path(scenario).is_file():
        scenario = str(Path(scenario).resolve())
    rows, parts, modes = [], {}, set()
    for done, case in enumerate(cases, start=1):
        seconds, parts[case.name], mode = _case(
            scenario, case, samples, against, repetitions, settling
        )
        modes.add(mode)
        ours = seconds.pop("")
        if mode != COMPILED:
            del seconds[INTERPRETER]
        found = [figure(case.name, ours, name, others) for name, others in seconds.items()]
        rows += found or [figure(case.name, ours)]
        progress(done)
    return {
        "scenario": scenario,
        "samples": samples,
        "repetitions": repetitions,
        "functions": modes.pop(),
        "rows": rows,
        "parts": parts,
    }


def _case(
    scenario: str,
    case: Case,
    samples: int,
    against: Path | None,
    repetitions: int,
    settling: int,
) -> tuple[dict[str, list[float]], dict[str, float], str]:
    """Seconds of a sample by reference ("" is what is measured), µs by part, kind of functions."""
    task = {
        "scenario": scenario,
        "algorithm": case.algorithm,
        "samples": settling + samples * (repetitions + 1),
        "settings": dict(case.settings),
    }
    environments = {"": {SWITCH: "now"}, INTERPRETER: {SWITCH: "never"}}
    if against is not None and case.shared:
        environments[str(against)] = {SWITCH: "now", "PYTHONPATH": str(against.resolve())}
    with ExitStack() as stack:
        workers = {
            name: stack.enter_context(_Worker(extra)) for name, extra in environments.items()
        }
        modes = {name: worker.ask(json.dumps(task)) for name, worker in workers.items()}
        for worker in workers.values():
            worker.ask(str(settling))
        seconds: dict[str, list[float]] = {name: [] for name in workers}
        for _ in range(repetitions):
            for name, worker in workers.items():
                seconds[name].append(worker.ask(str(samples)) / samples)
        profile = workers[""].ask(f"profile {samples}")
    return seconds, {part: 1e6 * value / samples for part, value in profile.items()}, modes[""]


class _Worker:
    """A process that learns when it is asked to."""

    def __init__(self, extra: Mapping[str, str]) -> None:
        self._extra = extra

    def __enter__(self) -> Self:
        """Start it; its errors go to a file."""
        self._errors = tempfile.TemporaryFile("w+", encoding="utf-8")
        source = Path(__file__).with_name("learner_process.py").read_text("utf-8")
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", source],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            text=True,
            env=os.environ | self._extra,
        )
        return self

    def ask(self, question: str) -> Any:
        """Its answer to a line; raises CosimError with its last words where it is dead."""
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(question + "\n")
            self._process.stdin.flush()
            return json.loads(self._process.stdout.readline())
        except (OSError, ValueError):
            self._process.wait()
            self._errors.seek(0)
            said = [line for line in self._errors.read().splitlines() if line.strip()]
            raise CosimError(f"a learner's process ended: {said[-1] if said else '?'}") from None

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End it."""
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._errors):
            if stream is not None:
                stream.close()
