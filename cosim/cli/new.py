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
        "python NAME.py",
        "cosim fmu check NAME.fmu --model NAME:model",
        "cosim scenario init NAME.fmu --model NAME:model --out NAME.toml",
        "cosim tuning --scenario NAME.toml",
        "cosim train --scenario NAME.toml --algorithm model-based --start cautious --samples 1440 "
        "--evaluation-seeds 2 --evaluation-steps 500 --out NAME-learned",
        "cosim evaluate --scenario NAME.toml --controllers "
        "naive,cautious,NAME-learned/parameters.toml --seeds 3 --steps 1000 --out NAME-run",
        "cosim export NAME-learned/parameters.toml --scenario NAME.toml --format c --out NAME-c",
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
    """Write a skeleton that runs, and print its commands; no file is replaced.

    A rule, a controller and a plant are Python modules; a study is a TOML file.

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

        is_word = re.fullmatch(r"[a-z]\w*", name, re.ASCII | re.IGNORECASE)
        if not is_word or iskeyword(name):
            raise CosimError(f"'{name}' is no name of a module: letters, digits and _, no keyword")
        # my_rule names the class MyRule.
        class_name = re.sub("(?:^|_)(.?)", lambda initial: initial[1].upper(), name)

        def fill_in(text: str) -> str:
            # In one pass: the user's name may itself hold CLASS.
            names = {"NAME": name, "CLASS": class_name}
            return re.sub("NAME|CLASS", lambda match: names[match[0]], text)

        files = {}
        for skeleton in sorted((SKELETONS / kind).iterdir()):
            # The suffix keeps tools that look for Python modules from taking skeletons for some.
            file_name = fill_in(skeleton.name).removesuffix(".in")
            files[out / file_name] = fill_in(skeleton.read_text("utf-8"))
        for file in files:
            if file.exists():
                raise CosimError(f"'{file}' is there already: give another name, or use --out")
        # The other module would be imported in place of the new one.
        if kind != "study" and find_spec(name):
            raise CosimError(f"there is a Python module '{name}' already: give another name")
        cli.writable_folder(out)
        for file, text in files.items():
            write_atomically(file, text)
        commands = [fill_in(command) for command in NEXT[kind]]
        if out != Path():
            commands = [f"cd {quote(str(out))}", *commands]
        written = [str(file) for file in files]
        out_.note("\n".join([f"written: {', '.join(written)}", "next:", *commands]))
        out_.json({"files": written, "next": commands})
