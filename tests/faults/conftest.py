import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))


@pytest.fixture(scope="session")
def files(tmp_path_factory):
    """Every reader with a good file."""
    from readers import readers

    return readers(tmp_path_factory.mktemp("good"))
