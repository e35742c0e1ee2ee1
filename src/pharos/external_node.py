"""Nodes outside this process."""
import contextlib
import urllib.parse
from typing import TYPE_CHECKING, Any, Dict, List, Optional

from pharos import on_demand
from pharos.errors import UnknownNodeError
from pharos.private_rospy.proxies import ServerProxy
from pharos.private_rospy.registration import COMMUNICATION_ERRORS
from pharos.seconds import check_seconds

if TYPE_CHECKING:
    from pharos.master import Master

TIMEOUT = 2.0  # seconds that a node may take to answer


def node_api(uri: str, timeout: float = TIMEOUT) -> Any:
    """ROS's slave API of the node at that URI, by XML-RPC: each call of it ends with an error after
    ``timeout`` seconds."""
    return ServerProxy(uri, timeout)


class ExternalNode:
    """An interface to any ROS node outside this process, written in any language.

    :ivar master: the :class:`Master` that it is of
    :ivar name: its full name
    """

    def __init__(self, master: 'Master', name: str) -> None:
        self.master = master
        self.name = name

    @property
    def uri(self) -> str:
        """The URI of its XML-RPC server."""
        return self.master.uri_of(self.name)

    @property
    def host(self) -> Optional[str]:
        """The host name or address that it advertises."""
        return urllib.parse.urlsplit(self.uri).hostname

    @property
    def pid(self) -> int:
        """Its process id, on its host."""
        return int(self._ask('getPid'))

    def is_alive(self) -> bool:
        """Whether it answers."""
        return self.master.is_node_alive(self.name)

    @property
    def publications(self) -> Dict[str, Optional[str]]:
        """``{topic: type}`` that it publishes, as the master knows it; the type is None where
        nobody has named it."""
        return self._topics(0)

    @property
    def subscriptions(self) -> Dict[str, Optional[str]]:
        """``{topic: type}`` that it is interested in, as :attr:`publications`."""
        return self._topics(1)

    def _topics(self, kind: int) -> Dict[str, Optional[str]]:
        types = dict(self.master.topic_types())
        return {name: types.get(name) for name in self._uses(kind)}

    @property
    def services(self) -> List[str]:
        """Names of the services that it offers."""
        return sorted(self._uses(2))

    def _uses(self, kind: int) -> List[str]:
        users = self.master.system_state()[kind]
        return [name for name, nodes in users.items() if self.name in nodes]

    def shutdown(self) -> None:
        """Ask it to stop, as ``rosnode kill`` does."""
        self._ask('getPid')  # tells whether it is there to be asked
        with contextlib.suppress(UnknownNodeError):  # it was gone before its answer was through
            self._ask('shutdown', 'asked for by pharos')

    def _ask(self, method: str, *args: str) -> Any:
        uri = self.uri
        try:
            return getattr(node_api(uri), method)('/pharos', *args)[2]
        except COMMUNICATION_ERRORS as error:
            raise UnknownNodeError(
                f'{self.name} is registered at {uri} but does not answer ({error}): if it is gone,'
                ' rosnode cleanup removes it'
            ) from error

    def describe(self, seconds: float = 1.0) -> str:
        """The node in words, as far as it and the master tell; see :meth:`Node.describe`.

        :raises UnknownNodeError: if the master knows it no more
        """
        seconds = check_seconds('seconds', seconds, least=0)
        text: str = on_demand.module('live.description').describe(self, seconds)
        return text

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, ExternalNode)
            and self.name == other.name
            and self.master == other.master
        )

    def __hash__(self) -> int:
        return hash((self.master, self.name))

    def __repr__(self) -> str:
        return f'<ExternalNode {self.name} of {self.master.url}>'
