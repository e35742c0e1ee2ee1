"""Nodes outside this process."""
from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from pharos.errors import UnknownNodeError
from pharos.private_rospy.xmlrpc import CALLER_ID, UNREACHABLE, ServerProxy

if TYPE_CHECKING:
    from pharos.master import Master


@dataclasses.dataclass(frozen=True)
class ExternalNode:
    """Any node outside this process; made by :meth:`Master.node`.

    ``node.interested_in(topic, from_=external)`` receives from this node alone.
    ``node.send_to(topic, block, to=external)`` sends to this node alone. The node need not live.

    :ivar name: the full name
    """

    master: Master
    name: str

    @property
    def uri(self) -> str:
        """The URI of the node's XML-RPC server, as registered at the master.

        :raises UnknownNodeError: if the master knows no such node any more
        """
        uri = self.master.call('lookupNode', self.name)
        if not uri:
            raise UnknownNodeError(
                f'no node {self.name} is known at {self.master.url}: see rosnode list'
            )
        return uri

    @property
    def host(self) -> str | None:
        """The host in the node's URI."""
        return urlsplit(self.uri).hostname

    def _call(self, method, *args):
        try:
            return getattr(ServerProxy(self.uri), method)(CALLER_ID, *args)[2]
        except (*UNREACHABLE, TypeError, LookupError) as error:
            raise UnknownNodeError(
                f'{self.name} does not answer: {error}; rosnode cleanup removes the dead'
            ) from None

    @property
    def pid(self) -> int:
        """The number of the node's process, on its host.

        :raises UnknownNodeError: if the node does not answer
        """
        return self._call('getPid')

    def is_alive(self) -> bool:
        """True if the node answers."""
        try:
            return self.pid > 0
        except UnknownNodeError:
            return False

    @property
    def publications(self) -> dict[str, str]:
        """The topics that the node publishes on, with their types, as the master knows them."""
        return self._names_in_state(0)

    @property
    def subscriptions(self) -> dict[str, str]:
        """The topics that the node receives from, with their types, as the master knows them."""
        return self._names_in_state(1)

    def _names_in_state(self, position):
        """Return the node's topics or services in one part of the master's system state.

        :param position: 0 for publications, 1 for subscriptions, 2 for services
        :returns: ``{name: type}``; the type is None for a service, or if the master knows none
        """
        types = dict(self.master.call('getTopicTypes'))
        users = self.master.system_state()[position]
        return {name: types.get(name) for name in sorted(users) if self.name in users[name]}

    @property
    def services(self) -> list[str]:
        """The names of the services that the node offers."""
        return list(self._names_in_state(2))

    def shutdown(self) -> None:
        """Ask the node to end, as rosnode kill does.

        :raises UnknownNodeError: if the node does not answer
        """
        self._call('shutdown', 'asked by pharos')
