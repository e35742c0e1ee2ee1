"""Time limits and periods as users give them."""
import math
import numbers
from typing import Any, Optional

import genpy

LONGEST = 2.0e6  # seconds; sockets and locks take no more than 24 days at once, and no infinity


def check_seconds(
    what: str, seconds: Any, above: float = -math.inf, least: float = -math.inf
) -> float:
    """``seconds`` as a number that everything that waits can take; one beyond LONGEST, or infinity,
    as LONGEST.

    :param what: the name of the parameter
    :param seconds: a number, or a genpy.Duration
    :raises ValueError: if it is none, not ``above`` that number, or less than ``least``
    """
    value: Any = seconds.to_sec() if isinstance(seconds, genpy.Duration) else seconds
    is_number = isinstance(value, numbers.Real)
    if not (is_number and value > above and value >= least):  # no comparison holds for NaN
        bound = f' above {above:g}' if above > -math.inf else ''
        bound = f', {least:g} or more' if least > -math.inf else bound
        raise ValueError(f'{what} is a number of seconds{bound}, not {seconds!r}')
    return float(max(-LONGEST, min(value, LONGEST)))


def check_limit(what: str, seconds: Any) -> Optional[float]:
    """A time limit as of :func:`check_seconds`; None, which is no limit, is None."""
    return None if seconds is None else check_seconds(what, seconds)
