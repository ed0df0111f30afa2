"""The RTI-NMPC as C: CasADi's code for its functions, a QP solver, a problem's constants."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from string import Template

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from controllers.errors import ControllerError
from controllers.functions import c_source, not_in_c, work_sizes
from controllers.preparation import SOLVED_RESIDUAL, Exact, SampleFunctions
from controllers.problem import Problem, VaryingKind, of_kind
from controllers.theta import Parameters, given_size
from cosim.core.protocols import Vector
from cosim.core.scenario import Scenario

ENGINE_SOURCES = Path(__file__).parent / "sources"
QP_SOURCES = ("qp.h", "qp_enter.h", "qp_refine.h", "qp_residual.h", "qp_set.h")
# The files of each solver of a sample's QP; the first is what `rti.h` includes.
CONDENSED_SOLVER = ("condensed.h", *QP_SOURCES)
STAGEWISE_SOLVER = ("stages.h", "qp_set.h")
# A sample's arrays live on the stack, of which a thread has 1 MB on some platforms.
STACK_LIMIT = 400_000
STATUSES = (
    "solved",
    "not convex",
    "iteration limit",
    "not finite",
    "θ not well posed",
    "inaccurate",
)


@dataclass(frozen=True)
class Observer:
    """Filter that turns an exported controller's inputs into a state.

    Attributes:
        rule: The file that defines the type Observer and its functions in C.
        sources: More files that it includes, by name.
        memory: Numbers in the type Observer.
        readings: Names of the variables that are read; none where the inputs are the state.
        estimates: Number of outputs that it has behind the controller's own.
    """

    rule: str
    sources: Mapping[str, bytes]
    memory: int
    readings: tuple[str, ...]
    estimates: int


def exact_state(problem: Problem) -> Observer:
    """The state as it is measured, without an estimator.

    Args:
        problem: Has the number of states.
    """
    return Observer("state_measured.h", {}, problem.n_states, (), 0)


@dataclass(frozen=True)
class Core:
    """A controller in C.

    Attributes:
        problem: The control problem that it was made for.
        parameters: θ that it starts from.
        sources: Files by name. `core.h` is what to include: it defines CoreState, core_reset,
            core_act, core_commit and core_outputs, all static.
        observer: What makes a state of its inputs.
        known_counts: Number of known values of each signal, in the order of `problem.varying`.
    """

    problem: Problem
    parameters: Parameters
    sources: Mapping[str, bytes]
    observer: Observer
    known_counts: tuple[int, ...]


def core(
    problem: Problem,
    parameters: Parameters,
    hessian: str = "gauss-newton",
    observer: Observer | None = None,
    known_counts: Sequence[int] = (),
) -> Core:
    """Write the C of an RTI-NMPC: deterministic, without allocation, C99.

    It computes as `RtiNmpc` does with the backend `daqp`, by a QP solver of its own; the
    parameters θ stay an input.

    Args:
        problem: The control problem.
        parameters: θ at the start.
        hessian: `gauss-newton` or `exact`.
        observer: What makes a state of the inputs; without one they are the state.
        known_counts: How many values of each of the problem's varying quantities are known at a
            sample, the present one first.

    Raises:
        ControllerError: Another `hessian`, a horizon too long for a thread's stack, readings so
            late that the estimator's memory is, or a model that calls what cannot be C.
    """
    assert len(known_counts) == len(problem.varying), "one for each varying quantity"
    if observer is None:
        observer = exact_state(problem)
    parameters.require_well_posed()
    functions = SampleFunctions(problem, parameters.blocks, hessian)
    reason = why_not_in_c(functions)
    if reason is not None:
        raise ControllerError(
            f"a controller with the model '{problem.model.name}' cannot be exported: {reason}; "
            "write it as expressions or as a table (casadi.interpolant)"
        )
    size = stack_needed(functions)
    if size > STACK_LIMIT:
        raise ControllerError(
            f"a horizon of {problem.horizon} needs {size / 1e3:.0f} kB of stack a sample, more "
            f"than the {STACK_LIMIT / 1e3:.0f} kB that an exported controller may take; shorten it"
        )
    # An importer's copy of the state may be on the stack too.
    memory = 8 * observer.memory
    if memory > STACK_LIMIT:
        raise ControllerError(
            f"the latest of the readings needs {memory / 1e3:.0f} kB for the earlier states that "
            f"the estimator keeps, more than the {STACK_LIMIT / 1e3:.0f} kB that an exported "
            "controller may take: shorten its delay"
        )
    sources = controller_sources(functions, observer=observer, known_counts=known_counts)
    return Core(problem, parameters, sources, observer, tuple(known_counts))


def controller_sources(
    functions: SampleFunctions,
    *,
    stagewise: bool = False,
    observer: Observer | None = None,
    known_counts: Sequence[int] = (),
) -> dict[str, bytes]:
    """C files of a controller.

    Args:
        functions: Its CasADi functions; those of `named` are in C.
        stagewise: Whether the QP is solved stage by stage; condensed else.
        observer: What makes a state of the inputs; without one they are the state.
        known_counts: Number of known values of each signal, where they are inputs.

    Returns:
        Contents by file name, the same bytes for the same functions.
    """
    if observer is None:
        observer = exact_state(functions.problem)
    names = [
        "core.h",
        "rti.h",
        observer.rule,
        *(STAGEWISE_SOLVER if stagewise else CONDENSED_SOLVER),
        "costs.h",
        "rotation.h",
        functions.hessian.source,
    ]
    sources = dict(observer.sources)
    for name in names:
        sources[name] = (ENGINE_SOURCES / name).read_bytes()
    # The preparation's graph maps the stage's function and is written by hand; stage by stage
    # nothing is condensed, so that no condensed vectors are embedded.
    unused = {"PREPARED", "EMBEDDED"} if stagewise else {"PREPARED"}
    called = []
    for prefix, part in functions.named.items():
        if prefix not in unused:
            called.append(part.function)
    sources["linearise.h"] = static_functions("linearise", [functions.stage])
    sources["functions.h"] = static_functions("functions", called)
    constants = _constants(functions, stagewise, observer.rule, known_counts)
    sources["problem.h"] = constants.encode()
    return sources


def why_not_in_c(functions: SampleFunctions) -> str | None:
    """Part of a controller's model that cannot be C (`not_in_c`); None if all can."""
    return not_in_c(_written(functions))


def _written(functions: SampleFunctions) -> list[ca.Function]:
    """The functions that become C; the preparation's graph maps `stage` and is done by hand."""
    written = [functions.stage]
    for prefix, part in functions.named.items():
        if prefix != "PREPARED":
            written.append(part.function)
    return written


def stack_needed(functions: SampleFunctions) -> int:
    """Upper bound of a sample's stack in bytes.

    CasADi's work vectors and the QP solver's arrays share their place; gcc and clang add 4 to 18 %
    and up to 4 kB.
    """
    problem = functions.problem
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    variables = horizon * m
    limits = horizon * (m + n)
    # Numbers in `RtiPrepared` and `RtiSolved`, in `QpWork` with the factorisation's arrays, and in
    # the responses of condensing.
    sample = functions.preparation.memory.size + functions.readout.memory.size
    working_set = limits * (variables + limits + 10) + 2 * limits
    factorisation = variables * (variables + 1)
    condensing = (horizon + 5) * n * (variables + n + 1)
    shared = max(working_set + factorisation, condensing)
    for function in _written(functions):
        work = sum(work_sizes("", function).values())
        shared = max(shared, work)
    bytes_needed = 8 * (sample + shared)
    return 4000 + round(1.2 * bytes_needed)


def static_functions(name: str, functions: Sequence[ca.Function]) -> bytes:
    """CasADi's C with every function static and without the compiler's remarks on it.

    Args:
        name: What the names of its helpers begin with.
        functions: The functions.
    """
    # All is included in one file, next to others' code: no name may leave it.
    helper = re.compile(r"^(?:const )?(?:casadi_real|casadi_int|void|int)\*? casadi_", re.MULTILINE)
    code = c_source(functions, name)
    code = helper.sub(lambda match: f"static {match.group()}", code)
    return filled("functions.h.in", code=code).encode()


def _constants(
    functions: SampleFunctions,
    stagewise: bool,
    observer: str,
    known_counts: Sequence[int],
) -> str:
    """Text of `problem.h`: sizes, the constants of problem and scale, and which files are used."""
    problem = functions.problem
    blocks = functions.blocks
    n = problem.n_states
    m = problem.n_actions
    sizes = {
        "N_X": n,
        "N_U": m,
        "N_W": n + m,
        "HORIZON": problem.horizon,
        "N_THETA": blocks.size,
        "N_VARYING": len(problem.varying),
        "N_GIVEN": given_size(problem, blocks),
        "N_KNOWN": sum(known_counts),
    }
    for prefix, call in functions.named.items():
        for name, place in call.slices.items():
            sizes[f"{prefix}_{name}"] = place.start
        sizes[f"{prefix}_SIZE"] = call.stack.size
        sizes |= work_sizes(prefix, call.function)
    sizes |= work_sizes("LINEARISE", functions.stage)
    for name, place in blocks.slices.items():
        sizes[f"THETA_{name}"] = place.start
    size_lines = [f"    {name} = {value}," for name, value in sizes.items()]

    arrays = {
        "REFERENCE_STATE": problem.reference_state,
        "REFERENCE_ACTION": problem.reference_action,
        "ACTION_LOWER": problem.action_lower,
        "ACTION_UPPER": problem.action_upper,
    }
    # Slack weights are read from θ, or else are constants.
    if "w_sigma" in blocks:
        slack = {
            "linear": "((theta) + THETA_w_sigma)",
            "quadratic": "((theta) + THETA_W_sigma)",
        }
    else:
        arrays["PENALTY_LINEAR"] = problem.penalty_linear
        arrays["PENALTY_QUADRATIC"] = problem.penalty_quadratic
        slack = {
            "linear": "((void)(theta), PENALTY_LINEAR)",
            "quadratic": "((void)(theta), PENALTY_QUADRATIC)",
        }
    scale = problem.scale
    rule = functions.hessian
    arrays |= {
        "SCALE_STATE": scale.state,
        "SCALE_ACTION": scale.action,
        "STATE_PRICE": scale.state_price,
        "BEND": rule.bend.reshape(-1),
        "SLOPE": rule.slope,
    }
    if isinstance(rule, Exact):
        arrays["METRIC"] = rule.metric.reshape(-1)
    arrays |= _moving_bound_rows(problem)
    arrays["DISCOUNTS"] = problem.discounts[:-1]
    arrays["SLACK_DISCOUNTS"] = problem.discounts[1:]
    array_lines = [array_text(name, values) for name, values in arrays.items()]
    end_discount = float(problem.discounts[-1])
    return filled(
        "problem.h.in",
        sizes="\n".join(size_lines),
        arrays="\n".join(array_lines),
        end_discount=repr(end_discount),
        floor=repr(Exact.FLOOR),
        residual=repr(SOLVED_RESIDUAL),
        cost_scale=repr(problem.scale.cost),
        rule=rule.source,
        observer=observer,
        # Where they are no inputs nobody reads this; an array has one entry at least.
        known=", ".join(map(str, known_counts or [1] * max(len(problem.varying), 1))),
        solver=(STAGEWISE_SOLVER if stagewise else CONDENSED_SOLVER)[0],
        signal_costs=str(int("SIGNAL" in functions.named)),
        **slack,
    )


def _moving_bound_rows(problem: Problem) -> dict[str, Vector]:
    """For each state the row of the signal that is its bound, −1 without one, and its nominal."""
    arrays = {}
    kinds: tuple[VaryingKind, ...] = ("lower", "upper")
    for kind in kinds:
        rows = np.full(problem.n_states, -1.0)
        nominal = np.zeros(problem.n_states)
        for row, item in of_kind(problem.varying, kind):
            rows[item.place] = row
            nominal[item.place] = item.nominal
        arrays[f"{kind.upper()}_SIGNALS"] = rows
        arrays[f"{kind.upper()}_NOMINAL"] = nominal
    return arrays


def filled(template: str, **values: str) -> str:
    """A template of `ENGINE_SOURCES` with values in the places of their names."""
    text = (ENGINE_SOURCES / template).read_text(encoding="utf-8")
    return Template(text).substitute(values)


def array_text(name: str, values: ArrayLike) -> str:
    """A constant array of doubles in C."""
    # `repr` gives back the same double: a constant in C has no rounding of its own.
    array = np.asarray(values, dtype=np.float64)
    numbers = ", ".join(_number(value) for value in array)
    return f"static const double {name}[] = {{{numbers}}};"


def _number(value: float) -> str:
    if np.isfinite(value):
        return repr(float(value))
    return "INFINITY" if value > 0 else "-INFINITY"


PLAIN_TEMPLATES = Path(__file__).parent / "plain"

_INCLUDE = re.compile(r'^[ \t]*#include "(?P<name>[\w.]+)"[ \t]*\n', re.MULTILINE)
_C_NAME = re.compile(r"[A-Za-z]\w*")


# Rounding alone leaves a KKT residual of up to 1e-2 in single precision.
_SINGLE = (
    (re.compile(r"\b1e-100\b"), "1e-37"),  # the least float is 1.2e-38
    (re.compile(r"(?<![\w.])(\d+\.\d*(?:e[-+]?\d+)?|\d+e[-+]?\d+)(?![\w.])"), r"\1f"),
    (re.compile(r"\bdouble\b"), "float"),
    (re.compile(r"\b(sqrt|fabs|fmin|fmax|floor|copysign|exp|log|pow|tanh?|sin|cos)\("), r"\1f("),
    (re.compile(r"%lf"), "%f"),
    (re.compile(r"(_MEMORY = \d+)"), r"\1 * 2"),  # the counters in it are not smaller
    (re.compile(r"(#define RTI_RESIDUAL) \S+"), r"\1 1e-2f"),
)


def plain_c(
    core: Core,
    name: str,
    scenario: Scenario,
    *,
    single: bool = False,
) -> dict[str, str]:
    """Text of ``NAME.c``, ``NAME.h``, ``main.c`` and ``CMakeLists.txt`` by file name.

    Args:
        core: The controller in C.
        name: What the functions' names begin with.
        scenario: The scenario that it was made for.
        single: Whether to have `float` in the place of `double`.

    Raises:
        ControllerError: `name` is no C name.
    """
    # The name goes into macros and functions: refuse it here, not in the compiler.
    if not _C_NAME.fullmatch(name):
        raise ControllerError(f"'{name}' is no name for C: letters, digits and _ only")
    problem = core.problem
    n = problem.n_states
    m = problem.n_actions
    horizon = problem.horizon
    # Numbers in `CoreGuess` and `CoreSolution`, and with these in `CoreState`.
    guess = horizon * (2 * n + m)
    solution = (horizon + 1) * n + horizon * m + guess + 3
    upper = name.upper()
    camel_case = "".join(part.capitalize() for part in name.split("_"))
    statuses = []
    for k, status in enumerate(STATUSES):
        ascii_status = status.replace("θ", "theta")
        word = re.sub(r"\W", "_", ascii_status).upper()
        statuses.append(f"    {upper}_{word} = {k}")
    numbers = [repr(value) for value in core.parameters.theta.tolist()]
    values = {
        "name": name,
        "Name": camel_case,
        "NAME": upper,
        "title": f"RTI-NMPC for {scenario.name}, theta {core.parameters.hash}",
        "version": version("rti-cosim"),
        "sampling_time": repr(float(scenario.sampling_time)),
        "n": n,
        "m": m,
        "states": ", ".join(scenario.plant.states),
        "actions": ", ".join(scenario.plant.actions),
        "parameters": core.parameters.blocks.size,
        "memory": guess + solution + 2 * m + 2 + core.observer.memory,
        "statuses": ",\n".join(statuses),
        "theta": ", ".join(numbers),
        "core": _joined(core),
        **_interface(core, upper),
        **_known_interface(core, upper),
    }
    names = {"controller.c": f"{name}.c", "controller.h": f"{name}.h"}
    files = {}
    for path in sorted(PLAIN_TEMPLATES.iterdir()):
        template = Template(path.read_text(encoding="utf-8"))
        text = template.substitute(values)
        if single and path.suffix in (".c", ".h"):
            for pattern, replacement in _SINGLE:
                text = pattern.sub(replacement, text)
        file_name = names.get(path.name, path.name)
        files[file_name] = text
    return files


def _known_interface(core: Core, upper: str) -> dict[str, str]:
    """Texts of the plain C on what is known of signals."""
    if not core.known_counts:
        return {
            "known": "0",
            "known_argument": "",
            "known_value": "",
            "known_size": "",
            "known_declaration": "",
            "known_read": "",
        }
    known = f"{upper}_KNOWN"
    parts = []
    for item, count in zip(core.problem.varying, core.known_counts, strict=True):
        parts.append(f"{item.signal} now" + (f" and {count - 1} ahead" if count > 1 else ""))
    return {
        "known": "known",
        "known_argument": f", const double known[{known}]",
        "known_value": ", known",
        "known_size": f"    {known} = {sum(core.known_counts)}, /* {'; '.join(parts)} */\n",
        "known_declaration": f"    double known[{known}];\n",
        "known_read": f"        for (int i = 0; i < {known}; i++)\n"
        '            if (scanf("%lf", &known[i]) != 1) return 0;\n',
    }


def _interface(core: Core, upper: str) -> dict[str, str]:
    """Texts of the plain C on what is measured: the state, or readings that may be missing."""
    names = core.observer.readings
    if not names:
        return {
            "measured": f"const double state[{upper}_STATES]",
            "arguments": "state",
            "about": _ABOUT_STATE,
            # In the C file.
            "gather": "",
            "gathered": "",
            "inputs": "state",
            "report": "",
            # In the header.
            "sizes": "",
            "members": "",
            # In the example.
            "what": "states",
            "note": "",
            "given": "state",
            "size": f"{upper}_STATES",
            "fresh": "",
            "mark": "",
        }
    readings = f"{upper}_READINGS"
    estimate = "core->observer.corrected.z[0]"
    return {
        "measured": f"const double y[{readings}], const int fresh[{readings}]",
        "arguments": "y, fresh",
        "about": _ABOUT_READINGS,
        "gather": _GATHER.replace("READINGS", readings),
        "gathered": f"    double inputs[2 * {readings}];\n    gather(y, fresh, inputs);\n",
        "inputs": "inputs",
        "report": f"    memcpy(report->estimate, {estimate}, sizeof report->estimate);\n",
        "sizes": f"    {readings} = {len(names)}, /* {', '.join(names)} */\n",
        "members": f"    double estimate[{upper}_STATES]; /* of the present state */\n",
        "what": "readings",
        "note": _NOTE,
        "given": "y",
        "size": readings,
        "fresh": f"    int fresh[{readings}];\n",
        "mark": f"        for (int i = 0; i < {readings}; i++) fresh[i] = y[i] == y[i];\n",
    }


_ABOUT_STATE = """ for a measured state, within its bounds; returns the status. A state that is not
 * finite is a failure like any other."""
_ABOUT_READINGS = """, within its bounds, for the readings y. Those that are fresh and finite are
 * taken up. Returns the status. Call it at each sample, without a fresh reading too: it predicts
 * the state."""
_GATHER = """static void gather(const double y[], const int fresh[], double inputs[]) {
    for (int i = 0; i < READINGS; i++) {
        inputs[i] = y[i];
        inputs[READINGS + i] = fresh[i] != 0;
    }
}

"""
_NOTE = """ * A reading that has not come is nan:    printf '25 50\\nnan 51\\n' | ./example
"""


def _joined(core: Core) -> str:
    """`core.h` with each file that it includes in the place of its first inclusion."""
    files = {name: data.decode() for name, data in core.sources.items()}
    # Which file stands for a macro, such as the rule of the Hessian, is said in `problem.h`.
    chosen = re.findall(r'#define (\w+_RULE) "([\w.]+)"', files["problem.h"])
    for macro, chosen_name in chosen:
        by_macro = f"#include {macro}"
        by_name = f'#include "{chosen_name}"'
        for name, text in files.items():
            files[name] = text.replace(by_macro, by_name)
    # Files guard themselves by their macros; joined into one text each comes once.
    seen: set[str] = set()

    def replace(match: re.Match[str]) -> str:
        name = match["name"]
        if name in seen:
            return ""
        seen.add(name)
        return _INCLUDE.sub(replace, files[name])

    return _INCLUDE.sub(replace, files["core.h"])
