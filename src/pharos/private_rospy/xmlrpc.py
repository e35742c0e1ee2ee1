"""Call masters and nodes by XML-RPC, with a limit of time."""
import xmlrpc.client
from http.client import HTTPException
from xml.parsers.expat import ExpatError

CALL_LIMIT = 5.0  # seconds for each question to a master or node
CALLER_ID = '/pharos'  # names a caller that has no node
UNREACHABLE = OSError, xmlrpc.client.Error, HTTPException, ExpatError


class _Transport(xmlrpc.client.Transport):
    def make_connection(self, host):
        connection = super().make_connection(host)
        connection.timeout = self.limit  # type: ignore[attr-defined]
        return connection

    def single_request(self, *args):
        try:
            return super().single_request(*args)
        finally:  # a call that Ctrl-C ended leaves an answer, which the next call would read
            self.close()


class ServerProxy(xmlrpc.client.ServerProxy):
    """A proxy of the XML-RPC server at a URI; a call raises one of UNREACHABLE after a limit.

    :param limit: seconds
    """

    def __init__(self, uri, limit=CALL_LIMIT):
        transport = _Transport()
        transport.limit = limit  # type: ignore[attr-defined]
        super().__init__(uri, transport)
