import subprocess
import sys

import pytest

MAKE = "gymnasium.make({name!r}, scenario='nominal').close()"


def run(script):
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", script], capture_output=True, text=True, check=False
    )


@pytest.mark.parametrize(
    "imports", ["import cosim, gymnasium", "import gymnasium, cosim"], ids=["before", "after"]
)
def test_importing_us_registers_the_environments_before_and_after_gymnasium(imports):
    names = ("cosim/Evaporator-v0", "cosim/EvaporatorNormalised-v0")
    done = run(f"{imports}; " + "; ".join(MAKE.format(name=name) for name in names))
    assert done.returncode == 0, done.stderr


def test_gymnasium_imports_us_by_the_name_before_the_colon():
    done = run("import gymnasium; " + MAKE.format(name="cosim:cosim/Evaporator-v0"))
    assert done.returncode == 0, done.stderr


def test_importing_us_does_not_import_gymnasium():
    done = run("import sys, cosim; assert 'gymnasium' not in sys.modules")
    assert done.returncode == 0, done.stderr
