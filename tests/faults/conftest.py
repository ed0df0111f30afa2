from tests.cosim.conftest import cosim  # noqa: F401 (a fixture)
