"""Services of any node, called by name alone."""
import io
import socket
import time

import rosgraph.network
import rosservice

from pharos import message_types
from pharos.errors import ServiceCallError, ServiceTypeError, UnknownServiceError, UnknownTypeError
from pharos.private_rospy import services
from pharos.private_rospy.host import rospy
from pharos.tcpros_connection import TcprosConnection


class Service:
    """A service of any node, to be called; made by :meth:`Master.lookup_service`.

    The report (listing 3.5)::

        service := master lookupService: '/clear' with: '/myID'. service call
        service = master.lookup_service('/clear', caller_id='/myID'); service.call()

    :attr:`type` and :attr:`md5sum` are found by asking the provider; a ``md5sum`` set by hand is what is sent.
    :attr:`response` is the last call's. May be called from several threads at once.
    """

    def __init__(self, master, name, caller_id, persistent=False):
        self.master, self.name, self.caller_id, self.persistent = master, name, caller_id, persistent
        self.response = None
        self._idle = []    # persistent connections that nobody uses just now
        self._look_up()
        header = self._ask()
        self.type = header.get('type')
        self.md5sum = self._found_md5sum = header.get('md5sum')

    def _look_up(self):
        """Find the provider, which may have moved."""
        try:
            self.uri = self.master._api(self.caller_id).lookupService(self.name)
        except rosgraph.MasterError:
            raise UnknownServiceError('no node of %s offers the service %s%s: see rosservice list' % (
                self.master.url, self.name, self.master.near(self.name, self.master.services()))) from None

    def _ask(self):
        """The provider's own description of the service: the header it answers a probe with, as rosservice does."""
        try:
            return rosservice.get_service_headers(self.name, self.uri)
        except (rosservice.ROSServiceException, rosgraph.network.ROSHandshakeException, OSError) as error:
            raise ServiceCallError('the provider of %s at %s does not answer (%s): is it still running? '
                                   'rosnode cleanup removes it if not' % (self.name, self.uri, error)) from error

    @property
    def service_class(self):
        """The service class of its type.

        :raises UnknownTypeError: if there is no definition of it here
        """
        return message_types.service_class(self.type)

    def call(self, block=None, *, timeout=None, **fields):
        """Call the service: ``block(request)`` and keywords fill the request. Returns the response.

        A service of a node of this process is called without a socket: without ``timeout`` in this thread, so that
        no wiring deadlocks, and with one in a thread of that node.

        :param timeout: seconds that the whole call may take; None: no limit
        :raises ServiceTypeError: if the md5sum set by hand does not fit
        :raises MessageTypeError: if a field does not exist or does not fit
        :raises ServiceCallError: if the provider fails, goes away or does not answer in time
        """
        service_class = self.service_class
        request = message_types.build(service_class._request_class, block, fields)
        message_types.check_fits(request)
        self.response = None
        here = services.find(self.name, self.uri)
        try:
            if here is not None and self.md5sum == self._found_md5sum:
                self.response = services.call(here, request, self.caller_id, timeout)
            else:
                self.response = self._call_over_tcp(service_class, request, timeout)
        except services.Failed as error:
            raise ServiceCallError('%s failed: %s' % (self.name, error)) from error
        except socket.timeout as error:
            raise ServiceCallError('%s did not answer in time: is its provider %s busy? Call it with a longer timeout='
                                   % (self.name, self.uri)) from error
        except (OSError, rosgraph.network.ROSHandshakeException) as error:
            raise ServiceCallError('the connection to %s at %s broke (%s): is its provider still running?'
                                   % (self.name, self.uri, error)) from error
        return self.response

    def _call_over_tcp(self, service_class, request, timeout):
        deadline = None if timeout is None else time.monotonic() + timeout
        buffer = io.BytesIO()
        request.serialize(buffer)
        connection = self._connection(deadline)
        try:
            ok, answer = connection.exchange(buffer.getvalue(), deadline)
        except BaseException:
            connection.close()
            raise
        if self.persistent:
            self._idle.append(connection)
        else:
            connection.close()
        if not ok:
            raise services.Failed(answer.decode(errors='replace'))
        return service_class._response_class().deserialize(answer)

    def _connection(self, deadline):
        """An idle connection that lives, or a new one; a provider that has moved is looked up again."""
        while self._idle:
            connection = self._idle.pop()
            if connection.is_alive():
                return connection
            connection.close()
        try:
            return self._connect(deadline)
        except (ConnectionRefusedError, rosgraph.network.ROSHandshakeException, _Refused):
            before = self.uri
            self._look_up()
            if self.uri == before:
                raise
            return self._connect(deadline)

    def _connect(self, deadline):
        connection = TcprosConnection(rospy.parse_rosrpc_uri(self.uri), {
            'service': self.name, 'callerid': self.caller_id, 'md5sum': self.md5sum or '',
            'persistent': '1' if self.persistent else '0'}, deadline)
        if 'error' in connection.header:
            connection.close()
            raise self._refused(connection.header['error'])
        return connection

    def _refused(self, reason):
        """The error of a provider that refuses the handshake: the report's "error message provides all information"."""
        if self.md5sum == self._found_md5sum:
            return _Refused('the provider of %s refused the call: %s' % (self.name, reason))
        try:
            request, response = self.service_class._request_class, self.service_class._response_class
            fields = 'request: %s; response: %s' % (message_types.describe_fields(request),
                                                    message_types.describe_fields(response))
        except UnknownTypeError:
            fields = 'its fields are not known here'
        return ServiceTypeError('the md5sum %r is not that of %s, which is of type %s with md5sum %s (%s): set that '
                                'one, or none' % (self.md5sum, self.name, self.type, self._found_md5sum, fields))

    def close(self):
        """Close the connections of a persistent service; a later call opens them again."""
        while self._idle:
            self._idle.pop().close()

    def __repr__(self):
        return '<Service %s %s at %s>' % (self.name, self.type, self.uri)


class _Refused(ServiceCallError):
    """Refused with the right md5sum: another node may be at the provider's old address by now."""
