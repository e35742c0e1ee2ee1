"""XML-RPC proxies with a time limit: the standard library's wait for ever for a peer that does not answer."""
import xmlrpc.client

import rosgraph

from pharos.private_rospy.lifetime import Interruption, shut

TIMEOUT = 10.0    # seconds for one call, where nothing else is said


class _Transport(xmlrpc.client.Transport):
    def __init__(self, timeout):
        super().__init__()
        self._timeout = timeout
        self._is_shut = False

    def make_connection(self, host):
        if self._is_shut:
            raise ConnectionAbortedError('it is not waited for any more')
        connection = super().make_connection(host)
        connection.timeout = self._timeout
        return connection

    def shut(self):
        """End the call under way in another thread; it raises an OSError."""
        self._is_shut = True
        connection = self._connection[1]
        sock = connection.sock if connection else None
        if sock is not None:
            shut(sock)


class ServerProxy(xmlrpc.client.ServerProxy):
    """``xmlrpc.client.ServerProxy`` whose calls raise an OSError after ``timeout`` seconds."""

    def __init__(self, uri, timeout=TIMEOUT, **options):
        super().__init__(uri, transport=_Transport(timeout), **options)


def interruption(proxy):
    """Within this, calls end with the node on whose behalf this thread runs.

    For questions alone: of what is to change something, nobody would know whether it has.
    """
    return Interruption(proxy('transport').shut)


def master_api(url, caller_id='/pharos', timeout=TIMEOUT):
    """rosgraph's own API of the master at ``url``, with a time limit of ``timeout`` seconds a call."""
    api = rosgraph.Master(caller_id, master_uri=url)
    api.handle = ServerProxy(url, timeout)
    return api
