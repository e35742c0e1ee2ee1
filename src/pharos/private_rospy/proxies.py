"""XML-RPC proxies with a time limit: the standard library's wait for ever for a peer that does not answer."""
import xmlrpc.client

import rosgraph

TIMEOUT = 10.0    # seconds for one call, where nothing else is said


class _Transport(xmlrpc.client.Transport):
    def __init__(self, timeout):
        super().__init__()
        self._timeout = timeout

    def make_connection(self, host):
        connection = super().make_connection(host)
        connection.timeout = self._timeout
        return connection


class ServerProxy(xmlrpc.client.ServerProxy):
    """``xmlrpc.client.ServerProxy`` whose calls raise an OSError after ``timeout`` seconds."""

    def __init__(self, uri, timeout=TIMEOUT, **options):
        super().__init__(uri, transport=_Transport(timeout), **options)


def master_api(url, caller_id='/pharos', timeout=TIMEOUT):
    """rosgraph's own API of the master at ``url``, with a time limit of ``timeout`` seconds a call."""
    api = rosgraph.Master(caller_id, master_uri=url)
    api.handle = ServerProxy(url, timeout)
    return api
