"""Nodes that are there only to look at topics, known by their names in whatever process."""

LOOKER = 'pharos_looks'  # how these names begin


def is_looker(name: str) -> bool:
    """Whether a node of that name is one."""
    return name.rpartition('/')[2].startswith(LOOKER + '_')
