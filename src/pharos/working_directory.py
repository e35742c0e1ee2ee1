"""Working directories of threads: on Linux a thread may have one of its own, and those that it starts
share it."""
import ctypes
import functools
import os
import threading

_CLONE_FS = 0x200  # of linux/sched.h: the working directory, the root and the umask


def enter(folder: str) -> None:
    """This thread is in that folder from now on, as are those that it starts from now on, and no
    others.

    :raises OSError: if there is no such folder, or the system does not allow it
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.unshare(_CLONE_FS):
        raise OSError(ctypes.get_errno(), 'unshare(CLONE_FS) is not allowed')
    os.chdir(folder)


@functools.lru_cache()
def is_possible() -> bool:
    """Whether :func:`enter` is allowed; in a container, it often is not."""
    allowed = []

    def attempt() -> None:
        try:
            enter(os.curdir)
            allowed.append(True)
        except (OSError, AttributeError):  # another system than Linux has no such function
            pass

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    return bool(allowed)
