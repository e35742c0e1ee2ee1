"""A package that does not reach it."""
import math, struct  # noqa: E401, F401


class Vector:
    """A class that all nodes share."""
