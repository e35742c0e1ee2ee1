"""Service: the caller's end of a service; it loads with the first one that is looked up."""
from __future__ import annotations

import io
import socket
import struct
from typing import Any

from rosgraph.network import (
    ROSHandshakeException,
    read_ros_handshake_header,
    write_ros_handshake_header,
)
from rospy import ServiceException
from rospy.core import parse_rosrpc_uri

from pharos import definitions, messages
from pharos.blocks import Block
from pharos.errors import (
    MessageTypeError,
    ServiceCallError,
    ServiceTypeError,
    UnknownServiceError,
)
from pharos.intraprocess.copier import serialize
from pharos.private_rospy.services import call_here, find_service
from pharos.private_rospy.tcpros import keep_alive, read_message
from pharos.waiting import current

LOOK_UP_LIMIT = 0.25  # seconds that the constructor waits for the type; call() asks again
TYPE_LIMIT = 5.0  # seconds that a call without a timeout waits for the type

# set by simulation: virtual time does not go by while a socket is waited for
ignores_timeout = False


class Service:
    """A service of any node, to be called; made by :meth:`Master.lookup_service`.

    The report: ``service := master lookupService: '/clear' with: '/myID'. service call``.

    :ivar name: the service's full name
    :ivar caller_id: the name of the calling node
    :ivar uri: the address of the provider
    :ivar type: the name of the service's type; None until the provider answers
    :ivar md5sum: the md5sum sent with a call: the provider's, unless a program sets another
    :ivar response: the response of the last call, or None
    """

    type: str | None = None
    md5sum: str | None = None
    response: Any = None

    def __init__(self, master, name, caller_id):
        self.master = master
        self.name = name
        self.caller_id = caller_id
        self.uri = self.master.call('lookupService', self.name)
        if not self.uri:
            raise UnknownServiceError(
                f'no node offers the service {self.name} at {self.master.url}: see rosservice list'
            )
        try:
            self._ask_type(LOOK_UP_LIMIT)
        except ConnectionRefusedError:
            raise UnknownServiceError(
                f'{self.name} was offered at {self.uri}, which has died: rosnode cleanup forgets it'
            ) from None
        except (OSError, ROSHandshakeException):  # call() asks again
            pass

    def _ask_type(self, timeout):
        """Ask the provider for the service's type and md5sum, within ``timeout`` seconds."""
        sock, header = self._connect('*', timeout, probe='1')
        self.type = header['type']
        self.md5sum = header['md5sum']
        sock.close()

    def call(self, block: Block | None = None, *, timeout: float | None = None, **fields):
        """Call the service, and return the response.

        Without a timeout, a provider of this process answers in this thread. The stop of a node
        ends the calls of its souls to other processes.

        :param block: ``block(request)`` fills a new request; or a dict, or a ready request
        :param timeout: seconds, None: without limit; a slow connection may add to them
        :param fields: fill the request by name
        :returns: the response; also in :attr:`response`
        :raises ServiceCallError: if the provider fails, is gone, or does not answer in time
        :raises ServiceTypeError: if :attr:`md5sum` differs from that of the type in this process
        :raises UnknownTypeError: if this process has no definition of the service's type
        :raises MessageTypeError: if the request cannot be sent
        """
        self.response = None
        try:
            if self.type is None:
                self._ask_type(timeout or TYPE_LIMIT)
            service_class = definitions.service_class(self.type)
            request = self._build_request(service_class, block, fields)
            self._check_md5sum(service_class)
            service = None
            if timeout is None or ignores_timeout:  # a timeout could not end a local call
                run, service = find_service(self.name, self.master.url, self.uri)
            if service:
                header = {'callerid': self.caller_id, 'service': self.name}
                self.response = call_here(run, service, request, header)
            else:
                self.response = self._call(service_class, serialize(request), timeout)
        except ServiceException as error:
            raise ServiceCallError(f'{self.name} failed: {error}') from error
        except (OSError, ROSHandshakeException) as error:
            raise ServiceCallError(
                f'the call of {self.name} at {self.uri} failed: {error!r}'
            ) from error
        return self.response

    def _build_request(self, service_class, block, fields):
        request_class = service_class._request_class
        request = messages.build(request_class, block, fields)
        if request._md5sum != request_class._md5sum:
            raise MessageTypeError(f'{self.name} takes {request_class._type}, not {request._type}')
        return messages.checked_copy(request)

    def _check_md5sum(self, service_class):
        if self.md5sum not in ('*', service_class._md5sum):
            raise ServiceTypeError(
                f'{self.name} is of type {self.type}, whose md5sum is {service_class._md5sum} here'
                f' (request {messages.fields_text(service_class._request_class)}; response'
                f' {messages.fields_text(service_class._response_class)}), and not {self.md5sum}: use'
                ' the same definition at both ends, or leave md5sum as it is'
            )

    def _call(self, service_class, data, timeout):
        """Call the provider by a socket, and return the response.

        :param data: the bytes of the request
        """
        try:
            sock, _ = self._connect(self.md5sum, timeout)
        except ConnectionError:  # the provider may have moved
            self.uri = self.master.call('lookupService', self.name) or self.uri
            sock, _ = self._connect(self.md5sum, timeout)
        with sock, sock.makefile('rb') as stream:
            sock.sendall(struct.pack('<I', len(data)) + data)
            is_failure = stream.read(1) == b'\0'
            answer = read_message(stream)
        if answer is None:
            raise ConnectionError('it closed the connection')
        if is_failure:
            raise ServiceException(answer.decode(errors='replace'))
        return service_class._response_class().deserialize(answer)

    def _connect(self, md5sum, timeout, **fields):
        """Connect to the provider, and return the socket and the header of the answer.

        :param fields: more fields of the header to send
        :raises ConnectionError: if the provider refuses
        """
        sock = socket.create_connection(parse_rosrpc_uri(self.uri), timeout)
        keep_alive(sock)
        if current.node:  # the node's stop ends the call
            current.node._current_run.calls.add(sock)
        names = {'callerid': self.caller_id, 'service': self.name, 'md5sum': md5sum}
        write_ros_handshake_header(sock, {**names, **fields})
        header = read_ros_handshake_header(sock, io.BytesIO(), 1 << 16)
        if 'error' in header:
            raise ConnectionError(header['error'])
        return sock, header

    def __repr__(self):
        return f'<Service {self.name} ({self.type}) at {self.uri}>'
