"""Counts in words."""


def counted(count: int, one: str, many: str = '') -> str:
    """'1 node', '2 nodes'; ``many`` is said where that is not ``one`` with an s."""
    return f'{count} {one if count == 1 else many or one + "s"}'
