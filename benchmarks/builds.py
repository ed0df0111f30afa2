"""Stored builds of the presets' controllers: `python -m benchmarks.builds` makes what is missing.

A build's name has the hash of its sources: what is stored under it is kept. To make all of them
anew, for another compiler say, delete `controllers/builds.tar.xz` first. It takes the extra
`cross`; all libraries of five platforms take some minutes.
"""

from __future__ import annotations

import io
import tarfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import patch

from controllers import ExtendedKalmanFilter, Parameters, Problem, RtiNmpc, ThetaBlocks
from controllers.functions import BUILDS, LONG, build_name
from controllers.optimum import table_sources
from cosim.core.files import replacing
from cosim.core.scenario import Scenario, presets
from fmus import PLATFORMS, Platform
from fmus.build import cross_compiler
from learning.empirical_model import Features
from learning.rollout import Rollout

SYSTEMS = {
    "x86_64-linux": ("linux", "x86_64"),
    "aarch64-linux": ("linux", "aarch64"),
    "x86_64-windows": ("win32", "amd64"),
    "x86_64-darwin": ("darwin", "x86_64"),
    "aarch64-darwin": ("darwin", "arm64"),
}
"""`sys.platform` and the machine that Python says, by platform."""


def preset_sources() -> list[dict[str, bytes]]:
    """C files by name of each library that a preset's controllers, filters and rollouts need.

    θ has the slack's weights, as in a training, or not; that of rollouts, which `model-based` has
    alone, the model's parameters too.
    """
    found: list[dict[str, bytes]] = []

    def keep(sources: Mapping[str, str | bytes]) -> None:
        each = {k: s.encode() if isinstance(s, str) else s for k, s in sources.items()}
        if each not in found:
            found.append(each)

    with (
        patch("controllers.rti.nmpc.library", keep),
        patch("controllers.filter_engine.library", keep),
        patch("learning.empirical_model.library", keep),
        patch("learning.rollout.library", keep),
    ):
        for preset in presets():
            scenario = Scenario.load(preset)
            if scenario.sensors:
                ExtendedKalmanFilter.from_scenario(scenario).compile()
            problem = Problem.from_scenario(scenario)
            names = tuple(parameter.name for parameter in problem.model.parameters)
            for slack_weights in (False, True):
                blocks = ThetaBlocks.from_problem(problem, slack_weights=slack_weights)
                RtiNmpc(problem, Parameters.naive(problem, blocks)).compile(LONG)
            # Under signals that a controller knows nothing is trained yet.
            if problem.varying:
                continue
            blocks = ThetaBlocks.from_problem(problem, slack_weights=True, model_parameters=names)
            Rollout(problem, Parameters.naive(problem, blocks), Features(problem))
    keep(table_sources())
    return found


def built(sources: Mapping[str, bytes], platform: Platform) -> bytes:
    """One library, optimised and with all its functions public."""
    options = ("-w", "-O3", "-fvisibility=default")
    return cross_compiler(platform).library(sources, "library", options)


def stored_builds() -> dict[str, bytes]:
    """The libraries of `BUILDS` by name; none where there is no such file."""
    if not BUILDS.is_file():
        return {}
    builds = {}
    with tarfile.open(BUILDS) as archive:
        for name in archive.getnames():
            member = archive.extractfile(name)
            assert member is not None
            builds[name] = member.read()
    return builds


def main() -> None:
    """Build what is missing, and write `BUILDS`."""
    wanted: dict[str, tuple[dict[str, bytes], Platform]] = {}
    for sources in preset_sources():
        for platform in PLATFORMS:
            wanted[build_name(sources, SYSTEMS[platform.tuple])] = sources, platform
    stored = stored_builds()
    missing = [name for name in wanted if name not in stored]
    print(f"{len(wanted)} libraries, {len(missing)} of them to build", flush=True)
    with ThreadPoolExecutor(2) as pool:
        made = pool.map(lambda name: built(*wanted[name]), missing)
        stored |= dict(zip(missing, made, strict=True))
    builds = {name: stored[name] for name in wanted}
    with replacing(BUILDS) as partial, tarfile.open(partial, "w:xz", preset=9) as archive:
        for name, data in builds.items():
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode = len(data), 0o755
            archive.addfile(entry, io.BytesIO(data))


if __name__ == "__main__":
    main()
