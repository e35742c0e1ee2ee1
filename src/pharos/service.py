"""Services: offered by a node, or called by name alone."""
from __future__ import annotations

import contextlib
import io
import socket
import struct
import time
import urllib.parse
from typing import Any

import rosgraph.network as network
import rospy

from pharos import messages, program
from pharos.blocks import taking
from pharos.channels import Opened
from pharos.errors import (
    MessageTypeError,
    NodeStoppedError,
    PharosError,
    ServiceCallError,
    ServiceTypeError,
    UnknownServiceError,
)
from pharos.intraprocess.copier import serialize
from pharos.private_rospy.patches import answer
from pharos.private_rospy.transport import keep_alive, local_service

PROBE_LIMIT = 5.0  # seconds until a provider that is called must have said its type
PATIENCE = 0.25  # seconds that a look-up waits for that; a call asks again


class OfferedService(Opened):
    """A service that a node offers; made by :meth:`Node.serve`.

    :ivar name: its full name
    """

    def __init__(self, node, name, cls, block):
        self.node, self.name, self.service_class = node, name, cls
        self.delegate = taking(block, 'block of a service', 1)
        self.open()

    def open(self) -> None:
        """Register it. Called again after the node was stopped and started."""
        self.node.master.call('getPid')  # raises if it does not answer
        try:
            self.end = self.node.ros.Service(self.name, self.service_class, self._answer)
        except rospy.ServiceException as error:
            raise PharosError(f'{self.node.name} offers {self.name} already: {error}') from None
        super().open()

    def _answer(self, request):
        try:
            return messages.response(self.service_class._response_class, self.delegate(request))
        except BaseException as error:
            where = f'service {self.name}'
            self.node.report(error, self.delegate, where, request, again=self._answer_again)
            raise rospy.ServiceException(f'{type(error).__name__}: {error}') from error

    def _answer_again(self, request):
        with contextlib.suppress(rospy.ServiceException):  # it is reported
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

    def look_up(self) -> None:
        """Ask the master for the provider, and the provider for the type.

        :raises UnknownServiceError: if nobody offers it
        """
        self.uri = self.master.call('lookupService', self.name)
        if not self.uri:
            raise UnknownServiceError(
                f'no node offers the service {self.name} at {self.master.url}: see rosservice list'
            )
        with contextlib.suppress(OSError, network.ROSHandshakeException):
            self._ask(PATIENCE)

    def _ask(self, limit):
        """Ask the provider for its type."""
        local = self._local()
        if local:
            cls = local[1].service_class
            self.type, self.md5sum = cls._type, cls._md5sum
            return
        sock, header = self._connect('*', time.monotonic() + limit, probe='1')
        self.type, self.md5sum = header['type'], header['md5sum']
        sock.close()

    def _local(self):
        return local_service(self.master.url, self.name, self.uri)

    def call(self, block: Any = None, *, timeout: float | None = None, **fields: Any) -> Any:
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
                self._ask(min(timeout or PROBE_LIMIT, PROBE_LIMIT))
            cls = messages.service_class(self.type)
            request = messages.build(cls._request_class, block, fields)
            if request._md5sum != cls._request_class._md5sum:
                raise MessageTypeError(
                    f'{self.name} takes {cls._request_class._type}, not {request._type}'
                )
            request = messages.check(request)
            if self.md5sum not in ('*', cls._md5sum):
                raise self._wrong_type(cls)
            if timeout is None and self._local():
                self.response = answer(*self._local(), request, self.caller_id)  # type: ignore[call-arg]
            else:
                self.response = self._call(cls, serialize(request), timeout)
        except rospy.ServiceException as error:
            raise ServiceCallError(f'{self.name} failed: {error}') from error
        except (OSError, network.ROSHandshakeException) as error:
            node = program.here.node
            if node and not node.is_running:
                raise NodeStoppedError(f'{node.name} stops, and the call with it') from None
            raise ServiceCallError(
                f'{self.name} at {self.uri} did not answer: {error!r}'
            ) from error
        return self.response

    def _call(self, cls, data, timeout):
        deadline = timeout and time.monotonic() + timeout
        try:
            sock, _ = self._connect(self.md5sum, deadline)
        except ConnectionError as error:
            before, self.uri = self.uri, self.master.call('lookupService', self.name)
            if not self.uri or self.uri == before:  # else it has moved
                raise ServiceCallError(f'{self.name} at {before} refused: {error}') from None
            sock, _ = self._connect(self.md5sum, deadline)
        with sock:
            sock.sendall(struct.pack('<I', len(data)) + data)
            is_ok, size = struct.unpack('<BI', _read(sock, 5, deadline))
            data = _read(sock, size, deadline)
        if not is_ok:
            raise rospy.ServiceException(data.decode(errors='replace'))
        return cls._response_class().deserialize(data)

    def _connect(self, md5sum, deadline, **more):
        """Return a socket to the provider, and the header that it answers."""
        parts = urllib.parse.urlsplit(self.uri)
        sock = socket.create_connection((parts.hostname, parts.port), _left(deadline))
        keep_alive(sock)
        if program.here.node:  # whose stop ends the call
            program.here.node.run.calls.add(sock)
        header = {'callerid': self.caller_id, 'service': self.name, 'md5sum': md5sum, **more}
        network.write_ros_handshake_header(sock, header)
        header = network.read_ros_handshake_header(sock, io.BytesIO(), 1 << 16)
        if 'error' in header:
            raise ConnectionError(header['error'])
        return sock, header

    def _wrong_type(self, cls):
        tried = self.md5sum
        self.look_up()
        right, self.md5sum = self.md5sum, tried
        request, response = cls._request_class, cls._response_class
        return ServiceTypeError(
            f'{self.name} is of type {self.type} with md5sum {right} (request'
            f' {messages.describe(request)}; response {messages.describe(response)}); the md5sum to'
            f' be sent is {tried}: this program knows it with md5sum {cls._md5sum}'
        )

    def __repr__(self) -> str:
        return f'<Service {self.name} ({self.type}) at {self.uri}>'


def _left(deadline):
    return deadline and max(deadline - time.monotonic(), 0.001)


def _read(sock, size, deadline):
    data = bytearray()
    while len(data) < size:
        sock.settimeout(_left(deadline))
        part = sock.recv(min(size - len(data), 1 << 20))
        if not part:
            raise ConnectionError('it closed the connection')
        data += part
    return bytes(data)
