"""Makes `import cosim` enough for `gymnasium.make("cosim/Evaporator-v0")`.

Gymnasium itself is not imported for it: who never does pays nothing.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import Loader
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

EPISODE_STEPS = 500
ENVIRONMENTS = {
    "cosim/Evaporator-v0": "cosim.environment:PlantEnv",
    "cosim/EvaporatorNormalised-v0": "cosim.environment:normalised",
}
"""Entry point of each environment by its id."""
_REGISTRY = "gymnasium.envs.registration"


def register_environments() -> None:
    """Register our environments with Gymnasium, now or as soon as somebody imports it."""
    if _REGISTRY in sys.modules:
        _register(sys.modules[_REGISTRY])
    else:
        sys.meta_path.insert(0, _WhenImported())


def _register(registry: ModuleType) -> None:
    for name, entry_point in ENVIRONMENTS.items():
        if name not in registry.registry:
            registry.register(name, entry_point, max_episode_steps=EPISODE_STEPS)


class _WhenImported:
    """Steps in front of the import of Gymnasium's registry, once."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name != _REGISTRY:
            return None
        sys.meta_path.remove(self)
        # Not imported above, since every command would pay for it.
        from importlib.util import find_spec  # noqa: PLC0415

        spec = find_spec(name)
        if spec is not None and spec.loader is not None:
            spec.loader = _Registering(spec.loader)
        return spec


class _Registering(Loader):
    """Executes a module as its own loader does, then adds our environments."""

    def __init__(self, loader: Any) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        module: ModuleType | None = self._loader.create_module(spec)
        return module

    def exec_module(self, module: ModuleType) -> None:
        self._loader.exec_module(module)
        _register(module)
