"""The fixtures of pharos.testing, the one way: by their names."""
from pharos.testing import create_node, expect_failures, master  # noqa: F401
