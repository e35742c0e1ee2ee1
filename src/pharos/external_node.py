"""Nodes outside this process."""
import urllib.parse

from pharos.errors import UnknownNodeError
from pharos.private_rospy.proxies import ServerProxy
from pharos.private_rospy.registration import COMMUNICATION_ERRORS

TIMEOUT = 2.0  # seconds that a node may take to answer


class ExternalNode:
    """An interface to any ROS node outside this process, written in any language."""

    def __init__(self, master, name):
        self.master, self.name = master, name

    @property
    def uri(self):
        """The URI of its XML-RPC server."""
        return self.master._find(self.name)

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
        return self.master.is_node_alive(self.name)

    @property
    def publications(self):
        """``{topic: type}`` that it publishes, as the master knows it; the type is None where
        nobody has named it."""
        return self._topics(0)

    @property
    def subscriptions(self):
        """``{topic: type}`` that it is interested in, as :attr:`publications`."""
        return self._topics(1)

    def _topics(self, kind):
        types = dict(self.master.topic_types())
        return {
            topic: types.get(topic)
            for topic, nodes in self.master.system_state()[kind].items()
            if self.name in nodes
        }

    @property
    def services(self):
        """Names of the services that it offers."""
        return sorted(
            name for name, nodes in self.master.system_state()[2].items() if self.name in nodes
        )

    def shutdown(self):
        """Ask it to stop, as ``rosnode kill`` does."""
        self._ask('getPid')  # tells whether it is there to be asked
        try:
            self._ask('shutdown', 'asked for by pharos')
        except UnknownNodeError:
            pass  # it was gone before its answer was through

    def _ask(self, method, *args):
        uri = self.uri
        try:
            return getattr(ServerProxy(uri, TIMEOUT), method)('/pharos', *args)[2]
        except COMMUNICATION_ERRORS as error:
            raise UnknownNodeError(
                f'{self.name} is registered at {uri} but does not answer ({error}): if it is gone,'
                ' rosnode cleanup removes it'
            ) from error

    def __eq__(self, other):
        return isinstance(other, ExternalNode) and (self.master, self.name) == (
            other.master,
            other.name,
        )

    def __hash__(self):
        return hash((self.master, self.name))

    def __repr__(self):
        return f'<ExternalNode {self.name} of {self.master.url}>'
