"""A module of the reporter's own."""
NAME = 'talking'
_runs = 0


def count():
    """How many times this was called since the module was loaded."""
    global _runs
    _runs += 1
    return _runs
