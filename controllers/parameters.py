"""The parameters θ of the controller: a value for each block, its file and its hash."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
from numpy.typing import ArrayLike, NDArray

from controllers.errors import ModelError, ParameterError
from controllers.problem import Problem
from controllers.theta import ThetaBlocks
from cosim.files import read_toml, write_atomically

Vector = NDArray[np.float64]
SCHEMA = 1
KEYS = ("schema", "hash", "theta", "model_parameters")


@dataclass(frozen=True)
class Parameters:
    """A value `theta` of θ, (blocks.size,), with its blocks; `parameters["B_l"]` is a whole block.

    Raises ParameterError on a vector of wrong length or with an entry that is not finite.
    """

    blocks: ThetaBlocks
    theta: Vector

    def __post_init__(self) -> None:
        """Keep a read-only copy of a valid vector."""
        theta = np.array(self.theta, dtype=np.float64)
        if theta.shape != (self.blocks.size,):
            raise ParameterError(f"θ has shape {theta.shape}; it must have ({self.blocks.size},)")
        if not np.isfinite(theta).all():
            bad = self.blocks.labels[int(np.flatnonzero(~np.isfinite(theta))[0])]
            raise ParameterError(f"θ is not finite at {bad}")
        theta.flags.writeable = False
        object.__setattr__(self, "theta", theta)

    def __getitem__(self, name: str) -> Vector:
        """Unpacked value of a block."""
        return self.blocks.block(name).unpack(self.theta[self.blocks.slices[name]])

    def replace(self, blocks: Mapping[str, ArrayLike]) -> Parameters:
        """Copy with the named blocks set to new values."""
        theta = self.theta.copy()
        for name, value in blocks.items():
            theta[self.blocks.slices[self.blocks.block(name).name]] = self.blocks.block(name).pack(
                value
            )
        return Parameters(self.blocks, theta)

    def with_theta(self, theta: ArrayLike) -> Parameters:
        """Copy with another flat vector."""
        return Parameters(self.blocks, np.asarray(theta, dtype=np.float64))

    def require_well_posed(self) -> None:
        """Raise ParameterError on an x_l not below its x_u or a slack weight not positive."""
        if not (self["x_l"] < self["x_u"]).all():
            raise ParameterError(f"θ: x_l = {self['x_l']} must stay below x_u = {self['x_u']}")
        for name in ("w_sigma", "W_sigma"):
            if name in self.blocks and not (self[name] > 0).all():
                raise ParameterError(f"θ: {name} = {self[name]} must be positive")

    @property
    def hash(self) -> str:
        """First 16 hexadecimal digits of the SHA-256 of names and exact values."""
        content = json.dumps([list(self.blocks.labels), [float(v).hex() for v in self.theta]])
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def __str__(self) -> str:
        """One line a block: name, meaning and value to six digits."""
        lines = [f"θ {self.hash} ({self.blocks.size} entries)"]
        for block in self.blocks:
            value = np.array2string(
                self[block.name], precision=6, suppress_small=True, separator=", "
            )
            lines.append(f"  {block.name:9s} {block.meaning:34s} {' '.join(value.split())}")
        return "\n".join(lines)

    @classmethod
    def naive(
        cls,
        problem: Problem,
        blocks: ThetaBlocks | None = None,
        *,
        value_offset: float | None = None,
    ) -> Parameters:
        """The paper's naive guess: B_l = I, B_Vf = I, c_lambda = ℓ_s, true bounds, else 0.

        `value_offset` is c_lambda where it shall not be ℓ_s, for instance ℓ_s/(1−γ). Slack weights
        in θ start at the true penalty, model parameters at their nominal values.
        """
        blocks = blocks or ThetaBlocks.of(problem)
        values: dict[str, ArrayLike] = {
            "B_l": np.eye(problem.n_states + problem.n_actions),
            "B_Vf": np.eye(problem.n_states),
            "c_lambda": problem.reference_cost if value_offset is None else value_offset,
            "x_l": problem.state_lower,
            "x_u": problem.state_upper,
        }
        if "w_sigma" in blocks:
            values["w_sigma"] = problem.penalty_linear
            values["W_sigma"] = problem.penalty_quadratic
        if "p" in blocks:
            chosen = problem.model.parameter_indices(blocks.block("p").labels)
            values["p"] = problem.model.nominal_parameters[chosen]
        return cls(blocks, np.zeros(blocks.size)).replace(values)

    def save(self, path: str | Path) -> Path:
        """Write θ as TOML with schema version and hash; the file appears whole or not at all."""
        values = {block.name: self[block.name].tolist() for block in self.blocks}
        document: dict[str, Any] = {"schema": SCHEMA, "hash": self.hash, "theta": values}
        if "p" in self.blocks:
            document["model_parameters"] = list(self.blocks.block("p").labels)
        return write_atomically(path, tomli_w.dumps(document))

    @classmethod
    def load(cls, path: str | Path, problem: Problem) -> Parameters:
        """Read θ for a problem; the file says which optional blocks it has.

        Raises ParameterError where the file is missing, is no TOML, has another schema, lacks or
        adds a key or a block, or where its values do not match its hash.
        """
        document = _read_document(Path(path))
        values = document["theta"]
        try:
            blocks = ThetaBlocks.of(
                problem,
                slack_weights="w_sigma" in values or "W_sigma" in values,
                model_parameters=tuple(document.get("model_parameters", ())),
            )
        except ModelError as error:
            raise ParameterError(f"{path}: {error}") from error
        missing = [name for name in blocks.slices if name not in values]
        unknown = [name for name in values if name not in blocks]
        if missing or unknown:
            raise ParameterError(
                f"{path}: θ blocks missing: {', '.join(missing) or 'none'}; "
                f"not known: {', '.join(unknown) or 'none'}"
            )
        try:
            parameters = cls(blocks, np.zeros(blocks.size)).replace(values)
        except ParameterError as error:
            raise ParameterError(f"{path}: {error}") from error
        if document.get("hash", parameters.hash) != parameters.hash:
            raise ParameterError(
                f"{path}: the values have hash {parameters.hash}, the file says "
                f"{document['hash']}; delete its line `hash` if the values were edited on purpose"
            )
        return parameters


def _read_document(path: Path) -> dict[str, Any]:
    document = read_toml(path, f"parameters file '{path}'", ParameterError)
    if document.get("schema") != SCHEMA:
        raise ParameterError(
            f"{path}: schema is {document.get('schema')!r}; this version reads schema = {SCHEMA}"
        )
    if unknown := [repr(key) for key in document if key not in KEYS]:
        raise ParameterError(
            f"{path}: not known: {', '.join(unknown)}; a parameters file holds {', '.join(KEYS)}"
        )
    if not isinstance(document.get("theta"), dict):
        raise ParameterError(f"{path}: there is no table [theta]")
    names = document.get("model_parameters", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise ParameterError(f"{path}: model_parameters must be a list of names")
    return document
