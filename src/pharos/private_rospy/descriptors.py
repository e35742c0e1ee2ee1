"""The descriptors of files and sockets, of which a process may have so many."""
import os
import resource

from pharos.errors import PharosError

NEEDED = 8  # while a node starts; later it has three, and one for each connection


def check_left(name: str) -> None:
    """Raise PharosError where too few are left for the node of that name to start.

    What fails for want of them says so only in some places: a file of settings is taken for empty,
    a master for gone.
    """
    opened = []
    try:
        for _ in range(NEEDED):
            opened.append(os.open(os.sep, os.O_RDONLY))
    except OSError as error:
        limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        raise PharosError(
            f'{name} cannot start: {error.strerror} ({limit} is the limit of this process). Raise it'
            ' before the program starts, by ulimit -n, or stop other nodes'
        ) from error
    finally:
        for each in opened:
            os.close(each)
