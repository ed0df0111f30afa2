"""Check of an FMU as a plant: its statements, and the results of trials."""

from __future__ import annotations

import zipfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import fmus
from cosim.core.errors import CosimError, PlantError
from cosim.core.scenario import Scenario
from cosim.plant.draft import first_document, guess_roles, number_roles
from cosim.plant.fmi import DESCRIPTION, SHIPPED_FMUS, UnpackedFmu, number, unpack
from cosim.plant.fmu_plant import FmuPlant
from cosim.plant.probe import AFTER, ProbeReport, Row, probe
from cosim.plant.starts import start_parameters
from cosim.plant.wiring import REALS, refusals
from fmus import FmuError
from fmus.check import information, problems_of

SAMPLES = 20
"""Steps of the run with the start values held."""
NAMES_SHOWN = 5
"""Names of a row at most."""


@dataclass(frozen=True)
class PlantCheck:
    """Result of `check_plant`.

    Attributes:
        fmu: the file.
        usable: whether the FMU can be a plant.
        verdict: the same in words.
        rows: what was looked at, what was seen and what follows.
        remarks: what the model description has against FMI's rules, which bears on other tools.
        report: the probe's; None where the FMU cannot be tried at all.
    """

    fmu: Path
    usable: bool
    verdict: str
    rows: tuple[Row, ...]
    remarks: tuple[str, ...] = ()
    report: ProbeReport | None = None

    def to_dict(self) -> dict[str, Any]:
        """The same as numbers, words and lists, for JSON."""
        document: dict[str, Any] = {
            "fmu": str(self.fmu),
            "usable": self.usable,
            "verdict": self.verdict,
            "rows": [asdict(row) for row in self.rows],
            "remarks": list(self.remarks),
        }
        if self.report is not None:
            report = self.report
            kinds = {}
            for name, kind in report.kinds.items():
                # The enumeration's name: its value is a sentence for the table.
                kinds[name] = kind.name.lower()
            document |= {
                "sha256": report.sha256,
                "outputs": report.outputs,
                "kinds": kinds,
                "restart": report.restart.name.lower(),
                "snapshots": report.snapshots,
                "serialises": report.serialises,
                "experiment": report.experiment._asdict(),
                "actions_that_move_no_state": list(report.still),
                "undriven_inputs": report.undriven,
            }
        return document


def check_plant(
    fmu: str | Path,
    *,
    states: Sequence[str] = (),
    actions: Sequence[str] = (),
    stage_cost: str | None = None,
    sampling_time: float | None = None,
) -> PlantCheck:
    """Find out whether an FMU can be a plant, and how. This runs its native code.

    Args:
        fmu: A shipped FMU's name, or a path.
        states: States, if known; see `cosim.plant.draft.guess_roles`.
        actions: Actions, if known.
        stage_cost: Stage cost, if known.
        sampling_time: Sampling time in s; without it the FMU's own step size.

    Returns:
        A table of what was found, and the verdict.

    Raises:
        CosimError: The file is missing or is no FMU, or a name is not one of its variables.
    """
    path = fmus.path(str(fmu)) if str(fmu) in SHIPPED_FMUS else Path(fmu)
    path = path.absolute()
    _require_fmu(path)
    # From here on an FMU that cannot be a plant is an answer, and no error.
    try:
        archive = unpack(path)
    except PlantError as error:
        return PlantCheck(path, False, f"it cannot be a plant: {error}", ())
    about = information(path, archive.description)
    remarks = tuple(problems_of(archive.folder))
    rows = [_interfaces(about), _platforms(about), _description(remarks)]

    def refused(reason: str) -> PlantCheck:
        return PlantCheck(path, False, f"it cannot be a plant: {reason}", tuple(rows), remarks)

    reasons = list(refusals(archive))
    if reasons:
        return refused("; ".join(reasons))
    document, roles = _document(path, archive, states, actions, stage_cost, sampling_time)
    rows.append(roles)
    rows.append(_step_size(archive, document["sampling_time"]))
    # Row by row: a refusal shows what was found before it.
    try:
        scenario = Scenario.from_dict(document)
        report = probe(scenario)
        rows += _probe_rows(report)
        rows.append(_starts_row(scenario, archive))
        rows.append(_run_row(scenario))
    except CosimError as error:
        return refused(str(error))
    return PlantCheck(
        fmu=path,
        usable=True,
        verdict=_verdict(report),
        rows=tuple(rows),
        remarks=remarks,
        report=report,
    )


def _require_fmu(path: Path) -> None:
    """Raise FmuError where there is no file, or no archive with a model description."""
    if not path.is_file():
        raise FmuError(f"there is no file {path}")
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except Exception as error:  # of damaged bytes zipfile raises a dozen types
        raise FmuError(f"{path} is not an FMU: {error}") from None
    if DESCRIPTION not in names:
        raise FmuError(f"{path} is not an FMU: it has no {DESCRIPTION}")


def _interfaces(about: dict[str, Any]) -> Row:
    interfaces = about["interfaces"]
    words = ", ".join(interfaces) or "none"
    used = "co-simulation is used" if "co-simulation" in interfaces else ""
    return Row("interfaces", f"FMI {about['fmi_version']}: {words}", used)


def _platforms(about: dict[str, Any]) -> Row:
    words = []
    for folder, made_for in about["platforms"].items():
        # What a file is made for is read from its own bytes: a folder's name may be wrong.
        if made_for:
            words.append(f"{folder} ({', '.join(made_for)})")
        else:
            words.append(folder)
    return Row("platforms", ", ".join(words) or "none", "")


def _description(remarks: Sequence[str]) -> Row:
    if not remarks:
        return Row("model description", "no flaw was found", "")
    noun = "remarks" if len(remarks) > 1 else "remark"
    count = f"{len(remarks)} {noun}, listed below"
    return Row("model description", count, "other tools may mind; the plant does not")


def _document(
    path: Path,
    archive: UnpackedFmu,
    states: Sequence[str],
    actions: Sequence[str],
    stage_cost: str | None,
    sampling_time: float | None,
) -> tuple[dict[str, Any], Row]:
    """A scenario to try the FMU with, and a row of the roles in it.

    Its other real outputs stand as disturbances. Where nobody can guess the roles, all outputs are
    states.
    """
    consequence = "as `cosim scenario init` would draft them"
    try:
        roles = guess_roles(archive, states, actions, stage_cost)
    except PlantError as error:
        # A name that is wrong is the user's to mend; a role that cannot be guessed is not.
        for name in (*states, *actions, stage_cost):
            if name and archive.variable(name) is None:
                raise
        roles = number_roles(archive, states, actions, stage_cost)
        consequence = str(error)
    default, internal = _stated_steps(archive)
    # One second where nobody says: a step of some size is needed to try the FMU.
    step = sampling_time or default or internal or 1.0
    document = first_document(path, archive, roles, step)
    has_role = (*roles.states, roles.stage_cost)
    others = []
    for name, variable in archive.variables.items():
        is_output = variable.causality == "output" and variable.type in REALS
        if is_output and not variable.shape and name not in has_role:
            others.append(name)
    # So the probe says of every output where it belongs.
    document["plant"]["disturbances"] = others
    document["plant"]["mapping"] = {}
    document["disturbance"] = {"law": "none"}
    states_shown = _some(roles.states)
    actions_shown = _some(roles.actions)
    words = f"states {states_shown}; actions {actions_shown}; cost {roles.stage_cost}"
    return document, Row("roles", words, consequence)


def _stated_steps(archive: UnpackedFmu) -> tuple[float, float]:
    """Step sizes in s that a model description states, default and internal; 0 for none."""
    experiment = archive.description.defaultExperiment
    default = number(getattr(experiment, "stepSize", None), 0.0)
    internal = number(archive.description.coSimulation.fixedInternalStepSize, 0.0)
    return default, internal


def _some(names: Sequence[str]) -> str:
    text = ", ".join(names[:NAMES_SHOWN])
    if len(names) > NAMES_SHOWN:
        text += f" … ({len(names)} in all)"
    return text


def _step_size(archive: UnpackedFmu, step: float) -> Row:
    default, internal = _stated_steps(archive)
    words = ["none stated"]
    if default > 0:
        words = [f"default {default:g} s"]
    if internal > 0:
        words.append(f"fixed internal step {internal:g} s")
    follows = f"tried with {step:g} s"
    if not default > 0:
        follows += "; the sampling time is yours to say"
    if internal > 0:
        follows += f"; every communication step is a multiple of {internal:g} s"
    return Row("step size", ", ".join(words), follows)


def _probe_rows(report: ProbeReport) -> list[Row]:
    """The probe's rows; that of the outputs with their names by kind, its start state left out."""
    by_kind: dict[str, list[str]] = defaultdict(list)
    for name, kind in report.kinds.items():
        by_kind[kind.value].append(name)
    sentences = []
    for words, names in by_kind.items():
        sentences.append(f"{_some(names)}: {words}")
    kinds = "; ".join(sentences)
    rows = []
    for row in report.rows:
        if row.subject == "outputs":
            rows.append(Row(row.subject, kinds, row.consequence))
        # What sets the start is looked for here.
        elif row.subject != "start state":
            rows.append(row)
    return rows


def _starts_row(scenario: Scenario, archive: UnpackedFmu) -> Row:
    parameters = start_parameters(scenario, archive)
    words = []
    for name, parameter in parameters.items():
        words.append(f"{name} by {parameter}")
    missing = [name for name in scenario.plant.states if name not in parameters]
    follows = "episodes can start anywhere"
    # Those of some states alone are of no use.
    if missing:
        words.append(f"nothing sets {_some(missing)}")
        follows = "episodes start where the FMU does"
    return Row("start state", _some(words), follows)


def _run_row(scenario: Scenario) -> Row:
    """Steps with the start values held; raises PlantError where the FMU fails."""
    with FmuPlant(scenario) as plant:
        plant.reset(0)
        # Start values need not lie between the FMU's own bounds.
        action = scenario.saturate(scenario.reference_action)
        for _ in range(SAMPLES):
            state = plant.step(action).s
    shown = ", ".join(f"{value:.4g}" for value in state[:NAMES_SHOWN])
    return Row("run", f"{SAMPLES} steps, all numbers finite", f"then the states are {shown}")


def _verdict(report: ProbeReport) -> str:
    words = ["it can be a plant"]
    kinds = set(report.kinds.values())
    # Where no output tells, they are read after the step as well, for want of a proof.
    if report.outputs == "after-step" and kinds & set(AFTER):
        words.append('its outputs are read after the step (plant.outputs = "after-step")')
    if report.restart.name != "RESET":
        words.append(report.restart.value + " for each episode")
    if report.still:
        words.append(f"but no state moves by {_some(tuple(report.still))} as things are")
    return "; ".join(words)
