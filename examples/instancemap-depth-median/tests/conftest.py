"""Has pytest show the values in an assertion of a contract that fails."""

import pytest

pytest.register_assert_rewrite("framework.testing")
