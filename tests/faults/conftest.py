from tests.cosim.conftest import cosim, unwatched  # noqa: F401 (fixtures)
