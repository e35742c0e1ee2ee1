"""Services: offered by a node, or called by name alone."""
import io
import socket
import struct
import time

import genpy
import rosgraph.network
import rosservice

from pharos import message_types
from pharos.blocks import check_block
from pharos.errors import PharosError, ServiceCallError, ServiceTypeError, UnknownServiceError, UnknownTypeError
from pharos.private_rospy.host import rospy

_RESPONSE_LIMIT = 1 << 30    # bytes; a length beyond is a broken stream


class OfferedService:
    """A service of a node; made by :meth:`Node.serve`."""

    def __init__(self, node, name, typed_as, block):
        self.node, self.name = node, name
        self.service_class = message_types.service_class(typed_as)
        self.block = check_block(block, 'service block', ('request',))
        if any(other.name == name for other in node._services):
            raise PharosError('%s offers %s already: close that one first' % (node.name, name))
        self._open()

    def _open(self):
        self._service = self.node.ros.Service(self.name, self.service_class, self._answer)
        self.node._services = [*self.node._services, self]

    @property
    def type(self):
        return self.service_class._type

    def _answer(self, request):
        try:
            return self._as_response(self.block(request))
        except Exception as error:
            self.node._report(error, self.block, 'service %s' % self.name)
            raise rospy.ServiceException('%s: %s' % (type(error).__name__, error)) from error

    def _as_response(self, value):
        """The response that the block meant: itself, its fields, or its only field."""
        response = self.service_class._response_class
        if isinstance(value, genpy.Message) and value._type == response._type:
            return value
        if isinstance(value, dict):
            return message_types.fill(response(), value)
        if not response.__slots__:
            return response()
        if len(response.__slots__) == 1 and value is not None:
            return message_types.fill(response(), {response.__slots__[0]: value})
        raise TypeError('the block of %s must return a response, a dict of its fields (%s)%s; it returned %r'
                        % (self.name, message_types.describe_fields(response),
                           ' or its only field' if len(response.__slots__) == 1 else '', value))

    def close(self):
        """Offer it no longer. Harmless when done twice."""
        if self in self.node._services:
            self.node._services = [other for other in self.node._services if other is not self]
            self._service.shutdown('closed')

    def __repr__(self):
        return '<OfferedService %s %s of %s>' % (self.name, self.type, self.node.name)


class Service:
    """A service of any node, to be called; made by :meth:`Master.lookup_service`.

    The report (listing 3.5)::

        service := master lookupService: '/clear' with: '/myID'. service call
        service = master.lookup_service('/clear', caller_id='/myID'); service.call()

    ``type`` and ``md5sum`` are found by asking the provider; a ``md5sum`` set by hand is what is sent. ``response`` is
    the last call's.
    """

    def __init__(self, master, name, caller_id):
        self.master, self.name, self.caller_id = master, name, caller_id
        self.response = None
        self.uri = self._look_up()
        header = self._ask()
        self.type = header.get('type')
        self.md5sum = self._found_md5sum = header.get('md5sum')

    def _look_up(self):
        try:
            return self.master._api(self.caller_id).lookupService(self.name)
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

        :param timeout: seconds that the whole call may take; None: no limit
        :raises ServiceTypeError: if the md5sum set by hand does not fit
        :raises MessageTypeError: if a field does not exist or does not fit
        :raises ServiceCallError: if the provider fails, goes away or does not answer in time
        """
        service_class = self.service_class
        request = service_class._request_class()
        if block is not None:
            block(request)
        message_types.fill(request, fields)
        buffer = io.BytesIO()
        try:
            request.serialize(buffer)
        except Exception:
            message_types.check_fits(request)
            raise
        self.response = None
        answer = self._exchange(buffer.getvalue(), None if timeout is None else time.monotonic() + timeout)
        self.response = service_class._response_class().deserialize(answer)
        return self.response

    def _exchange(self, request, deadline):
        """Send the serialized request, return the serialized response.

        rospy's ServiceProxy has no time limit and asks the environment's master, so the exchange is ours; the
        handshake is rosgraph's.
        """
        try:
            with socket.create_connection(rospy.parse_rosrpc_uri(self.uri), _left(deadline)) as sock:
                sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                rosgraph.network.write_ros_handshake_header(sock, {
                    'service': self.name, 'callerid': self.caller_id, 'md5sum': self.md5sum or '', 'persistent': '0'})
                rest = io.BytesIO()
                header = rosgraph.network.read_ros_handshake_header(_Timed(sock, deadline), rest, 4096)
                if 'error' in header:
                    raise self._refused(header['error'])
                sock.sendall(struct.pack('<I', len(request)) + request)
                stream = _Stream(_Timed(sock, deadline), rest.getvalue())
                ok, length = struct.unpack('<BI', stream.read(5))
                if length > _RESPONSE_LIMIT:
                    raise ServiceCallError('%s announced a response of %d bytes' % (self.name, length))
                answer = stream.read(length)
        except socket.timeout as error:
            raise ServiceCallError('%s did not answer in time: is its provider %s busy? Call it with a longer timeout='
                                   % (self.name, self.uri)) from error
        except (OSError, rosgraph.network.ROSHandshakeException) as error:
            raise ServiceCallError('the connection to %s at %s broke (%s): is its provider still running?'
                                   % (self.name, self.uri, error)) from error
        if not ok:
            raise ServiceCallError('%s failed: %s' % (self.name, answer.decode(errors='replace')))
        return answer

    def _refused(self, reason):
        """The error of a provider that refuses the handshake: the report's "error message provides all information"."""
        if self.md5sum == self._found_md5sum:
            return ServiceCallError('the provider of %s refused the call: %s' % (self.name, reason))
        try:
            request, response = self.service_class._request_class, self.service_class._response_class
            fields = 'request: %s; response: %s' % (message_types.describe_fields(request) or 'empty',
                                                    message_types.describe_fields(response) or 'empty')
        except UnknownTypeError:
            fields = 'its fields are not known here'
        return ServiceTypeError('the md5sum %r is not that of %s, which is of type %s with md5sum %s (%s): set that '
                                'one, or none' % (self.md5sum, self.name, self.type, self._found_md5sum, fields))

    def __repr__(self):
        return '<Service %s %s at %s>' % (self.name, self.type, self.uri)


def _left(deadline):
    """Seconds until ``deadline``; None where there is none."""
    if deadline is None:
        return None
    left = deadline - time.monotonic()
    if left <= 0:
        raise socket.timeout('time is up')
    return left


class _Timed:
    """A socket whose every ``recv`` keeps to one deadline for them all."""

    def __init__(self, sock, deadline):
        self._sock, self._deadline = sock, deadline

    def recv(self, size):
        self._sock.settimeout(_left(self._deadline))
        return self._sock.recv(size)


class _Stream:
    """Reads exactly as many bytes as asked for."""

    def __init__(self, source, data):
        self._source, self._data = source, bytearray(data)

    def read(self, size):
        while len(self._data) < size:
            received = self._source.recv(min(1 << 20, size - len(self._data) + 4096))
            if not received:
                raise ConnectionError('closed after %d of %d bytes' % (len(self._data), size))
            self._data += received
        result = bytes(self._data[:size])
        del self._data[:size]
        return result
