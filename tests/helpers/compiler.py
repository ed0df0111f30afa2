"""Tests that compile are skipped where nothing compiles."""

import pytest

from controllers.functions import find_compiler

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
