import sys

import pytest

from cosim import FmuPlant


@pytest.fixture(params=["evaporator", "evaporator_fmi3"])
def plant(request, paper):
    with FmuPlant(paper, request.param) as plant:
        yield plant


@pytest.fixture
def cosim(monkeypatch, capfd, tmp_path):
    """Run the command line in this process; returns exit code, standard output and error."""
    from cosim.cli import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["cosim", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            main()
        out, err = capfd.readouterr()
        return exit_.value.code or 0, out, err

    return run
