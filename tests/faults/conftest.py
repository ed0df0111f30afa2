import pytest

from tests.cosim.conftest import cosim  # noqa: F401 (a fixture)


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    """Every reader with a good file."""
    from tests.helpers.readers import readers

    return readers(tmp_path_factory.mktemp("good"))
