"""Services: offered by a node, or called by name alone."""
from __future__ import annotations

import contextlib
import socket
import struct
import time
from typing import TYPE_CHECKING, Any

import rosgraph.network as network
import rospy

from pharos import messages, program
from pharos.blocks import Block, rebound, taking
from pharos.errors import (
    MessageTypeError,
    PharosError,
    ServiceCallError,
    ServiceTypeError,
    UnknownServiceError,
)
from pharos.intraprocess.copier import copier_for, serialize
from pharos.private_rospy.patches import answer
from pharos.private_rospy.run import local_service
from pharos.private_rospy.transport import keep_alive

if TYPE_CHECKING:
    from pharos.master import Master
    from pharos.node import Node

PROBE_LIMIT = 5.0  # seconds in which a provider that is called must say its type
PATIENCE = 0.25  # seconds that a look-up waits for that; a call asks again


class OfferedService:
    """A service that a node offers; made by :meth:`Node.serve`.

    :ivar name: its full name
    """

    def __init__(self, node: Node, name: str, cls: type, block: Block):
        self.node, self.name, self.service_class = node, name, cls
        self.block = taking(block, 'block of a service', 1)
        self.closed = True
        node.master.call('getPid')
        self.open()
        node.remember(self)

    def open(self) -> None:
        """Register it. Called again after the node was stopped and started."""
        try:
            self.end = self.node.ros.Service(self.name, self.service_class, self._answer)
        except rospy.ServiceException as error:
            raise PharosError(f'{self.node.name} offers {self.name} already: {error}') from None
        self.closed = False

    def _answer(self, request: Any) -> Any:
        try:
            return messages.response(self.service_class._response_class, self.block(request))
        except BaseException as error:
            again = self._answer_again
            self.node.report(error, self.block, f'service {self.name}', request, again=again)
            raise self.node.run.ros.ServiceException(f'{type(error).__name__}: {error}') from error

    def _answer_again(self, request: Any) -> None:
        try:
            self._answer(request)
        except rospy.ServiceException:
            pass  # it is reported

    def close(self) -> None:
        """Offer it no more."""
        self.node.forget(self)
        if not self.closed:
            self.closed = True
            self.end.shutdown('closed')

    def rebind(self) -> None:
        self.block = rebound(self.block, self.node)

    def node_stopped(self) -> None:
        """Take note that rospy has closed it."""
        self.closed = True

    def __enter__(self):
        return self

    def __exit__(self, *error: Any) -> None:
        self.close()

    def __repr__(self) -> str:
        return f'<OfferedService {self.name} ({self.service_class._type}) of {self.node.name}>'


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

    def __init__(self, master: Master, name: str, caller_id: str):
        self.master, self.name, self.caller_id, self.response = master, name, caller_id, None
        self.type: str | None = None
        self.md5sum: str | None = None
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
        local = self._local()
        if local:
            self.type, self.md5sum = local[1].service_class._type, local[1].service_class._md5sum
            return
        with contextlib.suppress(OSError):
            self._ask(PATIENCE)

    def _ask(self, limit: float) -> None:
        """Ask the provider for its type."""
        with self._connect('*', limit, probe='1') as sock:
            header = self._read_header(sock, time.monotonic() + limit)
        self.type, self.md5sum = header.get('type'), header.get('md5sum')

    def call(self, block: Any = None, *, timeout: float | None = None, **fields: Any) -> Any:
        """Call it, with a request that ``block(request)``, a dict or keywords fill, or a ready one.

        :param timeout: seconds for the whole call, None: without limit
        :returns: the response; also in :attr:`response`
        :raises ServiceCallError: if the provider fails, is gone, or does not answer in time
        :raises ServiceTypeError: if the provider's md5sum is not ours
        :raises MessageTypeError: if the request cannot be sent
        """
        self.response = None
        if self.type is None:
            try:
                self._ask(PROBE_LIMIT if timeout is None else min(timeout, PROBE_LIMIT))
            except OSError as error:
                raise ServiceCallError(
                    f'{self.name} at {self.uri} does not say its type: {error}'
                ) from error
        cls = messages.service_class(self.type)
        request = messages.build(cls._request_class, block, fields)
        if request._md5sum != cls._request_class._md5sum:
            raise MessageTypeError(
                f'{self.name} takes {cls._request_class._type}, not {request._type}'
            )
        freeze, thaw = copier_for(cls._request_class)
        try:
            frozen = freeze(request)
        except Exception as error:
            raise messages.explain(request, error) from error
        local = self._local() if timeout is None else None
        if self.md5sum not in ('*', cls._md5sum):
            raise self._wrong_type(f'this program knows it with md5sum {cls._md5sum}')
        try:
            if local:
                self.response = answer(*local, thaw(frozen), self.caller_id)
            else:
                self.response = self._call_remote(cls, serialize(request), timeout)
        except rospy.ServiceException as error:
            raise ServiceCallError(f'{self.name} failed: {error}') from error
        except OSError as error:
            reason = error if str(error) else type(error).__name__
            raise ServiceCallError(f'{self.name} at {self.uri} did not answer: {reason}') from error
        return self.response

    def _local(self) -> Any:
        return local_service(self.master.url, self.name, self.uri)

    def _connect(self, md5sum: str, timeout: float | None, **more: str) -> socket.socket:
        host, _, port = self.uri[len('rosrpc://') :].rstrip('/').rpartition(':')
        sock = socket.create_connection((host, int(port)), timeout)
        keep_alive(sock)
        header = {'callerid': self.caller_id, 'service': self.name, 'md5sum': md5sum, **more}
        network.write_ros_handshake_header(sock, header)
        return sock

    def _read_header(self, sock: socket.socket, deadline: float | None) -> dict[str, str]:
        size = _read(sock, 4, deadline)
        header = _read(sock, *struct.unpack('<I', size), deadline)
        return network.decode_ros_handshake_header(size + header)

    def _call_remote(self, cls: type, data: bytes, timeout: float | None) -> Any:
        deadline = None if timeout is None else time.monotonic() + timeout
        try:
            sock, header = self._open_call(timeout, deadline)
        except ConnectionError:
            header = {'error': 'nobody is there'}
        if 'error' in header:
            before, self.uri = self.uri, self.master.call('lookupService', self.name)
            if not self.uri or self.uri == before:  # else it has moved
                raise ServiceCallError(f'{self.name} at {before} refused: {header["error"]}')
            sock, header = self._open_call(timeout, deadline)
        with sock:
            sock.sendall(struct.pack('<I', len(data)) + data)
            is_ok, size = struct.unpack('<BI', _read(sock, 5, deadline))
            data = _read(sock, size, deadline)
        if not is_ok:
            raise ServiceCallError(f'{self.name} failed: {data.decode(errors="replace")}')
        return cls._response_class().deserialize(data)

    def _open_call(self, timeout: float | None, deadline: float | None) -> tuple[Any, dict]:
        sock = self._connect(self.md5sum, timeout)
        header = self._read_header(sock, deadline)
        if 'error' in header:
            sock.close()
        return sock, header

    def _wrong_type(self, reason: str) -> PharosError:
        tried = self.md5sum
        self.look_up()
        right, self.md5sum = self.md5sum, tried
        cls = messages.service_class(self.type)
        request, response = cls._request_class, cls._response_class
        return ServiceTypeError(
            f'{self.name} is of type {self.type} with md5sum {right} (request'
            f' {messages.describe(request)}; response {messages.describe(response)}); the md5sum to'
            f' be sent is {tried}: {reason}'
        )

    def __repr__(self) -> str:
        return f'<Service {self.name} ({self.type}) at {self.uri}>'


def _read(sock: socket.socket, size: int, deadline: float | None = None) -> bytes:
    """Read so many bytes; ends with the node on whose behalf this thread runs."""
    data = bytearray()
    while len(data) < size:
        left = float('inf') if deadline is None else deadline - time.monotonic()
        if left <= 0:
            raise TimeoutError('the time limit of the call is over')
        sock.settimeout(min(left, program.PATIENCE))
        try:
            part = sock.recv(min(size - len(data), 1 << 20))
        except TimeoutError:
            program.check_waiting()
            continue
        if not part:
            raise ConnectionError('the provider closed the connection')
        data += part
    return bytes(data)
