"""The scenario: one validated document that says what plant is controlled, and to what end."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import tomli_w
from numpy.typing import NDArray
from pydantic import Field, ValidationError, model_validator

from cosim.errors import ScenarioError
from cosim.penalty import Penalty
from cosim.scenario.loading import merged, read
from cosim.scenario.tables import (
    BoundsTable,
    ControllerTable,
    DisturbanceTable,
    ExplorationTable,
    Name,
    PenaltyTable,
    PlantTable,
    Positive,
    Table,
)
from cosim.validation import describe


class Scenario(Table):
    """A benchmark task: plant, sampling, cost, disturbances, bounds and the controller's settings.

    Load one with `Scenario.load`; derive another with `replace`. Times in s, everything else in
    the FMU's units. Raises ScenarioError with one line that names file, field and allowed values.
    """

    schema_version: Annotated[Literal[1], Field(alias="schema")]
    """`schema` in the file: 1."""
    name: Name
    """What tables and figures call the scenario; it does not count in its hash."""
    description: str = ""
    """A line for readers."""
    sampling_time: Positive
    """Sampling time h in s; actions and disturbances are held that long."""
    discount: Annotated[float, Field(gt=0, le=1)]
    """Discount γ of the controller and of learning."""
    plant: PlantTable
    """Table `[plant]`: the true plant, an FMU."""
    disturbance: DisturbanceTable = DisturbanceTable()
    """Table `[disturbance]`: the law by which the FMU draws."""
    bounds: BoundsTable
    """Table `[bounds]`: the true bounds."""
    penalty: PenaltyTable
    """Table `[penalty]`: the price of a violation."""
    exploration: ExplorationTable | None = None
    """Table `[exploration]`: how training explores; without it that is left to the algorithm."""
    controller: ControllerTable
    """Table `[controller]`: what the controller is told."""

    @model_validator(mode="after")
    def _sizes_and_signs_fit(self) -> Self:
        plant, mapping, law = self.plant, self.plant.mapping, self.disturbance.law
        n, m, p = len(plant.states), len(plant.actions), len(plant.disturbances)
        for table, size, of, optional in (
            ("plant.initial_state", n, "state", False),
            ("plant.mapping.initial_state", n, "state", True),
            ("plant.mapping.nominal", p, "disturbance", True),
            ("plant.mapping.ranges", p, "disturbance", True),
            ("disturbance.nominal", p, "disturbance", law == "none"),
            ("disturbance.ranges", p, "disturbance", law == "none"),
            ("bounds.state_lower", n, "state", False),
            ("bounds.state_upper", n, "state", False),
            ("bounds.action_lower", m, "action", False),
            ("bounds.action_upper", m, "action", False),
            ("penalty.linear", n, "state", False),
            ("penalty.quadratic", n, "state", False),
            ("controller.reference_state", n, "state", False),
            ("controller.reference_action", m, "action", False),
        ):
            value: Any = self
            for part in table.split("."):
                value = getattr(value, part)
            if len(value) != size and not (optional and not value):
                raise _misfit(
                    table,
                    f"must have one entry per {of} (plant.{of}s has {size}), not {len(value)}",
                )
        explored = self.exploration
        deviations = () if explored is None else explored.standard_deviation
        if explored is not None and explored.kind != "none" and len(deviations) != m:
            raise _misfit(
                "exploration.standard_deviation",
                f"must have one entry per action (plant.actions has {m}), not {len(deviations)}",
            )
        for kind in ("state", "action"):
            lower = getattr(self.bounds, f"{kind}_lower")
            upper = getattr(self.bounds, f"{kind}_upper")
            if not all(low < high for low, high in zip(lower, upper, strict=True)):
                raise _misfit(f"bounds.{kind}_lower", f"must be below {kind}_upper in every entry")
        names = (*plant.states, *plant.actions, *plant.disturbances)
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise _misfit("plant", f"names '{twice}' twice among states, actions and disturbances")
        if law != "none" and not (mapping.law and law in mapping.law_codes):
            raise _misfit("disturbance.law", f"'{law}' needs plant.mapping.law and its law_codes")
        return self

    @classmethod
    def load(cls, source: str | Path) -> Scenario:
        """Load a preset by name or a TOML file by path; raises ScenarioError.

        A document with `extends = NAME_OR_PATH` states only what differs from another one.
        """
        document, origin = read(source)
        return cls._validated(document, origin)

    @classmethod
    def from_dict(cls, document: Mapping[str, Any], origin: str = "scenario") -> Scenario:
        """Validate a document, structured like the TOML file; raises ScenarioError."""
        return cls._validated(document, origin)

    @classmethod
    def _validated(cls, document: Mapping[str, Any], origin: str) -> Scenario:
        try:
            return cls.model_validate(document)
        except ValidationError as error:
            raise ScenarioError(f"{origin}: {describe(error, cls)}") from None

    def replace(self, changes: Mapping[str, Any]) -> Scenario:
        """Return the scenario with some fields changed, e.g. `{"plant": {"fmu": "my.fmu"}}`.

        Tables are merged, everything else is replaced; the result is validated as a whole.
        """
        return self._validated(merged(self.to_dict(), changes), f"scenario '{self.name}'")

    def to_dict(self) -> dict[str, Any]:
        """Return the document that this scenario was validated from, every default written out."""
        document: dict[str, Any] = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        # JSON has no infinity: bounds are taken as they are.
        document["bounds"] = {key: list(value) for key, value in self.bounds}
        return document

    def to_toml(self) -> str:
        """Return the scenario as TOML text that `load` reads back to an equal scenario."""
        return tomli_w.dumps(self.to_dict())

    @cached_property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 of all that bears on results.

        Left out: name, description, and the folder of a foreign FMU (its file name counts).
        """
        document = self.to_dict()
        del document["name"], document["description"]
        document["plant"]["fmu"] = Path(self.plant.fmu).name
        canonical = json.dumps(document, sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).hexdigest()[:16]

    @cached_property
    def initial_state(self) -> NDArray[np.float64]:
        """State at k = 0, (n,)."""
        return _frozen(self.plant.initial_state)

    @cached_property
    def state_lower(self) -> NDArray[np.float64]:
        """Lower bounds x_l, (n,)."""
        return _frozen(self.bounds.state_lower)

    @cached_property
    def state_upper(self) -> NDArray[np.float64]:
        """Upper bounds x_u, (n,)."""
        return _frozen(self.bounds.state_upper)

    @cached_property
    def action_lower(self) -> NDArray[np.float64]:
        """Lower bounds u_l, (m,)."""
        return _frozen(self.bounds.action_lower)

    @cached_property
    def action_upper(self) -> NDArray[np.float64]:
        """Upper bounds u_u, (m,)."""
        return _frozen(self.bounds.action_upper)

    @cached_property
    def limits(self) -> dict[str, tuple[float, float]]:
        """Lower and upper bound of each state and action by name."""
        names, bounds = (*self.plant.states, *self.plant.actions), self.bounds
        lower = (*bounds.state_lower, *bounds.action_lower)
        upper = (*bounds.state_upper, *bounds.action_upper)
        return dict(zip(names, zip(lower, upper, strict=True), strict=True))

    @cached_property
    def penalty_linear(self) -> NDArray[np.float64]:
        """Linear weights b of the violation, (n,)."""
        return _frozen(self.penalty.linear)

    @cached_property
    def penalty_quadratic(self) -> NDArray[np.float64]:
        """Quadratic weights B (diagonal) of the violation, (n,)."""
        return _frozen(self.penalty.quadratic)

    @cached_property
    def state_penalty(self) -> Penalty:
        """Penalty of a state beyond the bounds."""
        return Penalty(
            self.state_lower, self.state_upper, self.penalty_linear, self.penalty_quadratic
        )

    def saturate(self, action: NDArray[np.float64]) -> NDArray[np.float64]:
        """What the actuators make of actions (…, m): the nearest within their bounds."""
        return np.minimum(np.maximum(action, self.action_lower), self.action_upper)

    @cached_property
    def reference_state(self) -> NDArray[np.float64]:
        """Operating point x_s, (n,)."""
        return _frozen(self.controller.reference_state)

    @cached_property
    def reference_action(self) -> NDArray[np.float64]:
        """Operating point u_s, (m,)."""
        return _frozen(self.controller.reference_action)


def _misfit(field: str, message: str) -> ValueError:
    return ValueError(f"{field}: {message}")


def _frozen(values: tuple[float, ...]) -> NDArray[np.float64]:
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array
