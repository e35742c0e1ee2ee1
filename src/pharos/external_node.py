"""Nodes outside this process."""
import urllib.parse

import rosgraph

from pharos.errors import UnknownNodeError
from pharos.private_rospy.proxies import ServerProxy

TIMEOUT = 2.0    # seconds that a node may take to answer


class ExternalNode:
    """An interface to any ROS node outside this process, written in any language."""

    def __init__(self, master, name):
        self.master, self.name = master, name

    @property
    def uri(self):
        """The URI of its XML-RPC server."""
        try:
            return self.master._api().lookupNode(self.name)
        except rosgraph.MasterError:
            raise UnknownNodeError('no node %s at %s: see rosnode list' % (self.name, self.master.url)) from None

    @property
    def host(self):
        """The host name or address that it advertises."""
        return urllib.parse.urlsplit(self.uri).hostname

    @property
    def pid(self):
        """Its process id, on its host."""
        return self._ask('getPid')

    def is_alive(self):
        """Whether it answers."""
        return self.master.answers(self.name)

    @property
    def publications(self):
        """``{topic: type}`` that it publishes."""
        return dict(self._ask('getPublications'))

    @property
    def subscriptions(self):
        """``{topic: type}`` that it is interested in."""
        return dict(self._ask('getSubscriptions'))

    @property
    def services(self):
        """Names of the services that it offers."""
        return sorted(name for name, nodes in self.master.system_state()[2].items() if self.name in nodes)

    def shutdown(self):
        """Ask it to stop, as ``rosnode kill`` does."""
        self._ask('shutdown', 'asked for by pharos')

    def _ask(self, method, *args):
        code, message, value = getattr(ServerProxy(self.uri, TIMEOUT), method)('/pharos', *args)
        return value

    def __eq__(self, other):
        return isinstance(other, ExternalNode) and (self.master, self.name) == (other.master, other.name)

    def __hash__(self):
        return hash((self.master, self.name))

    def __repr__(self):
        return '<ExternalNode %s of %s>' % (self.name, self.master.url)
