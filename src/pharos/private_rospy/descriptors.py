"""The descriptors of files and sockets, of which a process may have so many."""
import os
import resource
from typing import Any, Optional, Set

from pharos.errors import PharosError
from pharos.private_rospy.registration import RETRY_DELAY
from pharos.private_rospy.threads import NoThreadError

STARTING = 8  # while a node starts; later it has three, and one for each connection
CONNECTING = 2  # for a connection to a publisher, and while that is asked for one


def check_left(count: int, what: str) -> None:
    """Raise PharosError where too few are left for what is to be done.

    What fails for want of them says so only in some places: a file of settings is taken for empty,
    a master for gone.

    :param count: how many it takes
    :param what: what cannot be done without, such as '/node cannot start'
    """
    opened = []
    try:
        for _ in range(count):
            opened.append(os.open(os.sep, os.O_RDONLY))
    except OSError as error:
        limit, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        raise PharosError(
            f'{what}: {error.strerror} ({limit} is the limit of this process). Raise it before the'
            ' program starts, by ulimit -n, or have fewer nodes and channels'
        ) from error
    finally:
        for each in opened:
            os.close(each)


class ForConnections:
    """Those that the connections of a node to publishers take.

    :param node: its :class:`~.instance.PrivateRospy`
    """

    def __init__(self, node: Any) -> None:
        self._node = node
        self._told: Set[str] = set()  # topics of which the log says that there were none

    def check(self, topic: str) -> None:
        """Raise PharosError where there are none to connect to a publisher of the topic."""
        check_left(CONNECTING, f'{self._node.name} cannot connect to {topic}')

    def tell_lack(self, topic: str, error: Optional[Exception] = None) -> None:
        """Say in the log, once for each topic, if that is why a connection has failed, or a lack of
        threads.

        :param error: what was raised
        """
        if topic not in self._told:
            lack = error if isinstance(error, NoThreadError) else self._lack(topic)
            if lack is not None:
                self._told.add(topic)
                self._node.warn(f'{lack}; meanwhile it is tried every {RETRY_DELAY:g} s')

    def _lack(self, topic: str) -> Optional[Exception]:
        try:
            self.check(topic)
        except PharosError as error:
            return error
        return None
