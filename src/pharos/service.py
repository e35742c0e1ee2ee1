"""Services: offered by a node, or called by name alone."""
import io
import socket
import struct
from contextlib import suppress
from time import monotonic
from types import SimpleNamespace
from typing import Any

from rosgraph.network import (
    ROSHandshakeException,
    read_ros_handshake_header,
    write_ros_handshake_header,
)
from rospy import ServiceException
from rospy.core import parse_rosrpc_uri

from pharos import messages
from pharos.blocks import taking
from pharos.channels import Opened
from pharos.errors import (
    MessageTypeError,
    PharosError,
    ServiceCallError,
    ServiceTypeError,
    UnknownServiceError,
)
from pharos.intraprocess.copier import copied, serialize
from pharos.private_rospy.transport import keep_alive, local_service
from pharos.program import here

PATIENCE = 0.25  # seconds that a look-up waits for that; a call asks again


class OfferedService(Opened):
    """A service that a node offers; made by :meth:`Node.serve`.

    :ivar name: its full name
    """

    def __init__(self, node, name, cls, block):
        self.node, self.name, self.service_class = node, name, cls
        self.delegate = taking(block, 'block of a service', 1, 1)
        self.open()

    def _open(self):
        try:
            self.end = self.node.ros.Service(self.name, self.service_class, self._answer)
        except ServiceException as error:
            raise PharosError(f'{self.node._name} offers {self.name} already: {error}') from None

    def _close(self):
        self.end.shutdown()

    def _answer(self, request):
        try:
            return messages.response(self.service_class._response_class, self.delegate(request))
        except BaseException as error:
            where = f'service {self.name}'
            self.node._report(error, self.delegate, where, request, again=self._answer_again)
            raise ServiceException(f'{type(error).__name__}: {error}') from error

    def _answer_again(self, request):
        with suppress(ServiceException):  # it is reported
            self._answer(request)


class Service:
    """A service of any node, to be called; made by :meth:`Master.lookup_service`.

    The report: ``service := master lookupService: '/clear' with: '/myID'. service call``.

    :ivar name: its full name
    :ivar caller_id: in whose name it is called
    :ivar uri: where it is offered
    :ivar type: the name of its type, as the provider says
    :ivar md5sum: what is sent; it is the provider's unless it is set
    :ivar response: the response of the last call, or None
    """

    type: str | None = None
    md5sum: str | None = None
    response: Any = None

    def __init__(self, master, name, caller_id):
        self.master, self.name, self.caller_id = master, name, caller_id
        self.look_up()

    def look_up(self):
        """Ask the master for the provider, and the provider for the type.

        :raises UnknownServiceError: if nobody offers it
        """
        self.uri = self.master.call('lookupService', self.name)
        if not self.uri:
            raise UnknownServiceError(
                f'no node offers the service {self.name} at {self.master.url}: see rosservice list'
            )
        try:
            self._ask(PATIENCE)
        except ConnectionRefusedError:
            raise UnknownServiceError(
                f'{self.name} was offered at {self.uri}, which has died: rosnode cleanup forgets it'
            ) from None
        except (OSError, ROSHandshakeException):  # a call asks again
            pass

    def _ask(self, limit):
        """Ask the provider for its type."""
        sock, header = self._connect('*', limit, probe='1')
        self.type, self.md5sum = header['type'], header['md5sum']
        sock.close()

    def call(self, block=None, *, timeout: float | None = None, **fields):
        """Call it, with a request that ``block(request)``, a dict or keywords fill, or a ready one.

        :param timeout: seconds for the whole call, None: without limit
        :returns: the response; also in :attr:`response`
        :raises ServiceCallError: if the provider fails, is gone, or does not answer in time
        :raises ServiceTypeError: if the provider's md5sum is not ours
        :raises MessageTypeError: if the request cannot be sent
        """
        self.response = None
        try:
            if self.type is None:
                self._ask(timeout or 5.0)
            cls = messages.service_class(self.type)
            request = messages.build(cls._request_class, block, fields)
            if request._md5sum != cls._request_class._md5sum:
                raise MessageTypeError(
                    f'{self.name} takes {cls._request_class._type}, not {request._type}'
                )
            request = messages.check(request)
            if self.md5sum not in ('*', cls._md5sum):
                raise ServiceTypeError(
                    f'{self.name} is of type {self.type}, whose md5sum is {cls._md5sum} here (request'
                    f' {messages.describe(cls._request_class)}; response'
                    f' {messages.describe(cls._response_class)}), and not {self.md5sum}: use the'
                    ' same definition at both ends, or leave md5sum as it is'
                )
            local = timeout is None and local_service(self.name, self.uri)
            if local:
                self.response = self._call_here(local, request)
            else:
                self.response = self._call(cls, serialize(request), timeout)
        except ServiceException as error:
            raise ServiceCallError(f'{self.name} failed: {error}') from error
        except (OSError, ROSHandshakeException) as error:
            raise ServiceCallError(
                f'the call of {self.name} at {self.uri} failed: {error!r}'
            ) from error
        return self.response

    def _call_here(self, service, request):
        """Have a rospy.Service of this process answer in this thread."""
        answers = []
        connection = SimpleNamespace(
            write_buff=io.BytesIO(),
            send_message=lambda response, seq: answers.append(copied(response)),
            write_data=lambda data: answers.append(ServiceException(data[5:].decode())),
        )
        request._connection_header = {'callerid': self.caller_id, 'service': self.name}
        service._handle_request(connection, request)
        if isinstance(answers[0], Exception):
            raise answers[0]
        return answers[0]

    def _call(self, cls, data, timeout):
        end = timeout and monotonic() + timeout
        try:
            sock, _ = self._connect(self.md5sum, timeout)
        except ConnectionError:  # it may have moved
            self.uri = self.master.call('lookupService', self.name) or self.uri
            sock, _ = self._connect(self.md5sum, timeout)
        with sock:
            sock.sendall(struct.pack('<I', len(data)) + data)
            is_ok, size = struct.unpack('<BI', _read(sock, 5, end))
            data = _read(sock, size, end)
        if not is_ok:
            raise ServiceException(data.decode(errors='replace'))
        return cls._response_class().deserialize(data)

    def _connect(self, md5sum, timeout, **more):
        """Return a socket to the provider, and the header that it answers."""
        sock = socket.create_connection(parse_rosrpc_uri(self.uri), timeout)
        keep_alive(sock)
        if here.node:  # whose stop ends the call
            here.node._run.calls.add(sock)
        header = {'callerid': self.caller_id, 'service': self.name, 'md5sum': md5sum, **more}
        write_ros_handshake_header(sock, header)
        header = read_ros_handshake_header(sock, io.BytesIO(), 1 << 16)
        if 'error' in header:
            raise ConnectionError(header['error'])
        return sock, header

    def __repr__(self):
        return f'<Service {self.name} ({self.type}) at {self.uri}>'


def _read(sock, size, end):
    data = bytearray()
    while len(data) < size:
        sock.settimeout(end and max(end - monotonic(), 0.001))
        part = sock.recv(min(size - len(data), 1 << 20))
        if not part:
            raise ConnectionError('it closed the connection')
        data += part
    return bytes(data)
