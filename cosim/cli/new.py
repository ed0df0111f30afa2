"""`cosim new`: runnable skeletons of rules, controllers, plants and studies."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from cosim.cli import output as cli

SKELETONS = Path(__file__).parents[1] / "skeletons"
"""A folder for each kind; in texts and file names NAME is the user's, CLASS it as a class's."""
NEXT = {
    "rule": ["cosim train --algorithm NAME:CLASS --samples 400 --out NAME-run"],
    "controller": ["cosim evaluate --controllers naive,NAME:make --steps 100 --out NAME-run"],
    "plant": [
        "python build_NAME.py",
        "cosim scenario init NAME.fmu --out NAME-drafted.toml",
        "cosim simulate --scenario NAME.toml --steps 500 --out NAME-run",
    ],
    "study": ["cosim study run NAME.toml --out NAME-run"],
}
"""Commands to run next, from the files' folder."""


def new(
    kind: Literal["rule", "controller", "plant", "study"],
    name: str,
    out: cli.OutOption = Path(),
    json: cli.JsonOption = False,
) -> None:
    """Write a skeleton that runs, and print the commands; replaces no file.

    A rule and a controller are Python modules, a plant is C, a model and a scenario, a study TOML.

    Args:
        name: Name of files, module and class.
    """
    with cli.output(json) as out_:
        import re
        from importlib.util import find_spec
        from keyword import iskeyword
        from shlex import quote

        from cosim.core.errors import CosimError
        from cosim.core.files import write_atomically

        if not re.fullmatch(r"[a-z]\w*", name, re.ASCII | re.IGNORECASE) or iskeyword(name):
            raise CosimError(f"'{name}' is no name of a module: letters, digits and _, no keyword")
        names = {"NAME": name, "CLASS": re.sub("(?:^|_)(.?)", lambda m: m[1].upper(), name)}

        def filled(text: str) -> str:
            return re.sub("NAME|CLASS", lambda match: names[match[0]], text)

        files = {
            out / filled(path.name).removesuffix(".in"): filled(path.read_text("utf-8"))
            for path in sorted((SKELETONS / kind).iterdir())
        }
        if there := next(filter(Path.exists, files), None):
            raise CosimError(f"'{there}' is there already: give another name, or use --out")
        if kind != "study" and find_spec(name):
            raise CosimError(f"there is a Python module '{name}' already: give another name")
        cli.writable_folder(out)
        for path, text in files.items():
            write_atomically(path, text)
        commands = [f"cd {quote(str(out))}"] * (out != Path()) + [*map(filled, NEXT[kind])]
        out_.note("\n".join([f"written: {', '.join(map(str, files))}", "next:", *commands]))
        out_.json({"files": list(map(str, files)), "next": commands})
