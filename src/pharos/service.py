"""Services of any node, called by name alone."""
import contextlib
import math
import socket
import time
from typing import TYPE_CHECKING, Any, Callable, Dict, Iterator, List, Optional, Union

import genpy
import rosgraph

from pharos import messages
from pharos.blocks import check_filler
from pharos.errors import (
    NodeStoppedError,
    ServiceCallError,
    ServiceTypeError,
    UnknownServiceError,
    suggest,
)
from pharos.intraprocess.copier import serialized
from pharos.intraprocess.services import Failed
from pharos.intraprocess.sharing import numbered
from pharos.private_rospy import local_services
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.deadlines import deadline_in, time_limit
from pharos.private_rospy.lifetime import Interruption
from pharos.private_rospy.tcpros_connection import TcprosConnection
from pharos.seconds import check_limit

if TYPE_CHECKING:
    from pharos.master import Master

TIMEOUT = 5.0  # seconds in which the master, and a provider asked for its type, must answer
PATIENCE = 0.25  # seconds that a look-up waits for the provider, which is asked again when need be


class Service:
    """A service of any node, to be called; made by :meth:`Master.lookup_service`.

    The report (listing 3.5)::

        service := master lookupService: '/clear' with: '/myID'. service call
        service = master.lookup_service('/clear', caller_id='/myID'); service.call()

    :attr:`type` and :attr:`md5sum` are found by asking the provider. A call sends the md5sum of the
    definition that fills the request, so that the provider refuses one of another layout; a
    ``md5sum`` set by hand is sent instead, until it is set to None. May be called from several
    threads at once.

    :ivar master: the :class:`Master` that it is of
    :ivar name: its full name
    :ivar caller_id: in whose name it is called
    :ivar persistent: whether connections are kept between calls
    :ivar response: that of the last call; None before the first
    :ivar uri: the URI of the provider
    """

    def __init__(
        self,
        master: 'Master',
        name: str,
        caller_id: str,
        persistent: bool = False,
        patience: float = PATIENCE,
    ) -> None:
        self.master = master
        self.name = name
        self.caller_id = caller_id
        self.persistent = persistent
        self.response: Any = None
        self.uri = ''
        self._calls = 0
        self._class: Any = None
        self._local: Any = None  # the provider, where it is a node of this process
        self._idle: List[TcprosConnection] = []  # persistent, and nobody uses them just now
        self._md5sum_by_hand: Optional[str] = None
        self._told: Optional[Dict[str, str]] = None  # the provider's description, once it gave one
        self._look_up(None)
        with contextlib.suppress(_Silent):
            self._told = self._ask(patience=patience)

    def _look_up(self, deadline: Optional[float]) -> str:
        """Find the provider, which may have moved; returns its URI."""
        with time_limit(None if deadline is None else deadline - time.monotonic()):
            try:
                self.uri = self.master.call('lookupService', self.name, caller_id=self.caller_id)
            except rosgraph.MasterError:
                hint = suggest(self.name, self.master.services())
                raise UnknownServiceError(
                    f'no node of {self.master.url} offers the service {self.name}{hint}: see'
                    ' rosservice list'
                ) from None
        return self.uri

    @property
    def is_described(self) -> bool:
        """Whether the provider has answered, so that its type is known."""
        return self._told is not None

    def _description(self, deadline: Optional[float] = None) -> Dict[str, str]:
        """What the provider last told of the service; it is asked where it has not yet."""
        if self._told is None:
            self._look_up(deadline)
            self._told = self._ask(deadline)
        return self._told

    def _ask(self, deadline: Optional[float] = None, patience: float = math.inf) -> Dict[str, str]:
        """The provider's own description of the service: the header that it answers a probe with.

        As ``rosservice.get_service_headers`` asks for it, which hides why there is none, and waits
        for ever for a provider that sends a byte every four seconds.
        """
        limit, waiting = deadline_in(min(TIMEOUT, patience)), Interruption()
        if deadline is not None:
            limit = min(limit, deadline)
        try:
            connection = self._connect({**self._header('*'), 'probe': '1'}, limit)
        except OSError as error:
            self._check_awaited(waiting, error)
            kind = _Silent if isinstance(error, socket.timeout) else ServiceCallError
            raise kind(
                f'the provider of {self.name} at {self.uri} does not answer ({error}): is it still'
                ' running? rosnode cleanup removes it if not'
            ) from error
        connection.close()
        if 'error' in connection.header:
            raise ServiceCallError(
                f"the node at {self.uri} says of {self.name}: {connection.header['error']}. Its"
                " provider is gone: rosnode cleanup removes it"
            )
        return connection.header

    @property
    def type(self) -> Any:
        """The name of its type, as the provider tells it.

        :raises ServiceCallError: if the provider has not told it yet, and does not answer now
        """
        return self._description().get('type')

    @property
    def md5sum(self) -> Optional[str]:
        """The provider's md5sum, or the one set by hand; setting it to None takes that back.

        :raises ServiceCallError: as :attr:`type`
        """
        by_hand = self._md5sum_by_hand
        return self._description().get('md5sum') if by_hand is None else by_hand

    @md5sum.setter
    def md5sum(self, md5sum: Optional[str]) -> None:
        if not isinstance(md5sum, (str, type(None))):
            found = self._description().get('md5sum')
            raise ValueError(
                f'the md5sum of {self.name} is a text such as {found!r}, not {md5sum!r}: where it'
                ' comes from YAML, as parameters do, put one of digits alone in quotes (\"\'0\'\")'
            )
        self._md5sum_by_hand, self._local = md5sum, None

    @property
    def service_class(self) -> Any:
        """The service class of its type, as it is defined here.

        :raises UnknownTypeError: if there is no definition of it here
        """
        if self._class is None:
            self._class = messages.service_class(self.type)
        return self._class

    def call(
        self,
        block: Union[Callable[[Any], Any], Dict[str, Any], genpy.Message, None] = None,
        *,
        timeout: Optional[float] = None,
        **fields: Any,
    ) -> Any:
        """Call the service, with a request filled by keywords, ``block(request)``, or both; or with
        a ready request. Returns the response.

        A service of a node of this process is called without a socket: without ``timeout`` in this
        thread, so that no wiring deadlocks, and with one in a thread of that node.

        :param block: ``block(request)``; a dict of fields, in which alone one is set that is called
            ``block`` or ``timeout``; or a ready request
        :param timeout: seconds that the whole call may take; None: no limit
        :raises ServiceTypeError: if the type is defined otherwise here than at the provider, the
            provider changed it, or the md5sum set by hand does not fit
        :raises MessageTypeError: if a field does not exist or does not fit
        :raises UnknownServiceError: if it is no longer offered
        :raises ServiceCallError: if the provider fails, goes away or does not answer in time
        :raises NodeStoppedError: if the node whose soul or delegate waits for the answer stops
            meanwhile
        """
        if not isinstance(block, genpy.Message):
            check_filler(block, lambda: self.service_class._request_class, 'request')
        timeout = check_limit('timeout', timeout)
        deadline = None if timeout is None else time.monotonic() + timeout
        self.response = None
        self._check_definition(deadline)
        cls = self.service_class._request_class
        messages.check_not_hidden(cls, block, timeout=timeout)
        request = messages.ready_or_built(cls, block, fields, self.name)
        self._calls += 1
        request = numbered(request, self._calls)
        waiting = Interruption()
        try:
            self.response = response = self._exchange(request, deadline)
        except Failed as error:
            raise ServiceCallError(f'{self.name} failed: {error}') from None
        except socket.timeout as error:
            raise ServiceCallError(
                f'{self.name} did not answer in time ({timeout} s): is its provider at'
                f' {self.uri} busy? Call it with a longer timeout='
            ) from error
        except (OSError, genpy.DeserializationError) as error:
            self._check_awaited(waiting, error)
            raise ServiceCallError(
                f'the connection to {self.name} at {self.uri} broke ({error}): is its provider'
                ' still running?'
            ) from error
        return response  # not self.response, which is another thread's by now

    def _check_definition(self, deadline: Optional[float]) -> None:
        """Refuse a definition that is not the provider's, before anybody wonders which fields a
        request has."""
        told = self._description(deadline)
        ours = self.service_class._md5sum
        if self._md5sum_by_hand is not None or told.get('md5sum') in (None, '*', ours):
            return
        self._look_up(deadline)
        header = self._ask(deadline)  # it may have been built anew since it was looked up
        if header.get('md5sum') != ours:
            raise self._type_error(header)
        self._told = {**told, 'md5sum': ours}

    def _check_awaited(self, waiting: Interruption, error: Exception) -> None:
        """Raise NodeStoppedError where a connection broke because the node that waits stops."""
        if waiting.came:
            raise NodeStoppedError(f'the node that waited for {self.name} stops') from error

    def _exchange(self, request: genpy.Message, deadline: Optional[float]) -> genpy.Message:
        """Send the request to the provider, and where that has gone, to where it is now; returns
        the response."""
        uri = self.uri
        try:
            return self._send(request, deadline)
        except (ConnectionRefusedError, _HandshakeRefused) as error:
            if self._look_up(deadline) == uri:
                raise self._refused(error, deadline)
        try:
            return self._send(request, deadline)
        except _HandshakeRefused as error:
            raise self._refused(error, deadline)

    def _send(self, request: genpy.Message, deadline: Optional[float]) -> genpy.Message:
        """Send the request to where the provider is thought to be; returns the response."""
        local = self._local
        if local is None or not local.is_offered(self.uri):
            if local is not None:
                self._look_up(deadline)
            local = self._local = local_services.find(
                self.name, self.uri, self.service_class, self._md5sum_sent
            )
        try:
            data = local.freeze(request) if local else serialized(request)
        except Exception:
            messages.check_fits(request)  # tells what of it does not
            raise
        if local:
            return local.call(data, self._header(self._md5sum_sent), deadline)
        return self._send_over_tcp(data, deadline)

    def _send_over_tcp(self, data: bytes, deadline: Optional[float]) -> genpy.Message:
        connection = self._connection(deadline)
        try:
            ok, answer = connection.exchange(data, deadline)
        except BaseException:
            connection.close()
            raise
        if self.persistent:
            self._idle.append(connection)
        else:
            connection.close()
        if not ok:  # roscpp gives no reason
            raise Failed(answer.decode(errors='replace') or 'its provider gives no reason')
        response = self.service_class._response_class().deserialize(answer)
        response._connection_header = connection.header
        return response

    @property
    def _md5sum_sent(self) -> str:
        by_hand = self._md5sum_by_hand
        return self.service_class._md5sum if by_hand is None else by_hand

    def _header(self, md5sum: str) -> Dict[str, str]:
        header = {'service': self.name, 'md5sum': md5sum, 'callerid': self.caller_id}
        if self.persistent:
            header['persistent'] = '1'
        return header

    def _connection(self, deadline: Optional[float]) -> TcprosConnection:
        """An idle connection that lives, or a new one."""
        header = self._header(self._md5sum_sent)
        for connection in self._take_idle():
            # not made with an md5sum that was set meanwhile
            if connection.sent == header and connection.is_alive():
                return connection
            connection.close()
        connection = self._connect(header, deadline)
        if 'error' in connection.header:
            connection.close()
            raise _HandshakeRefused(connection.header['error'])
        return connection

    def _take_idle(self) -> Iterator[TcprosConnection]:
        with contextlib.suppress(IndexError):  # another thread has taken the last one
            while True:
                yield self._idle.pop()

    def _connect(self, header: Dict[str, str], deadline: Optional[float]) -> TcprosConnection:
        return TcprosConnection(rospy.parse_rosrpc_uri(self.uri), header, deadline)

    def _refused(self, error: Exception, deadline: Optional[float]) -> Exception:
        """The error of a provider that refuses, by what it says of itself now."""
        if isinstance(error, ConnectionRefusedError):
            return error
        header = self._ask(deadline)
        if header.get('md5sum') == self._md5sum_sent:
            refused: Exception = ServiceCallError(
                f'the provider of {self.name} at {self.uri} refused the call: {error}'
            )
        else:
            refused = self._type_error(header)
        refused.__cause__ = error
        return refused

    def _type_error(self, header: Dict[str, str]) -> ServiceTypeError:
        """The error of a provider whose type is another than what is sent.

        The report: the "error message provides all information about the service including the
        md5sum".
        """
        type_, md5sum = header.get('type', ''), header.get('md5sum', '')
        by_hand = self._md5sum_by_hand
        theirs = f'{type_} with md5sum {md5sum} ({self._fields_of(type_, md5sum)})'
        if by_hand is not None:
            return ServiceTypeError(
                f'the md5sum {by_hand!r} is not that of {self.name}, which is of type {theirs}: set'
                ' that one, or none'
            )
        if type_ != self.type:
            return ServiceTypeError(
                f'the md5sum {self.service_class._md5sum!r} is not that of {self.name}, which is of'
                f' type {theirs}: it was {self.type} when it was looked up: look it up again'
            )
        ours = self.service_class
        self._class = self._local = None  # the right definition may come, and is sought then
        return ServiceTypeError(
            f'{self.name} is of type {theirs}, but {type_} is defined here with md5sum'
            f' {ours._md5sum} ({messages.describe_service(ours)}), so nothing was sent: have'
            f' both sides use the same {type_.rpartition("/")[2]}.srv'
        )

    def _fields_of(self, type_: str, md5sum: str) -> str:
        """What can be said of the fields of a provider's type; a provider elsewhere tells its
        md5sum alone."""
        local = local_services.class_of(self.name, self.uri)
        for known in (local, *messages.known_service_classes(type_)):
            if known is not None and known._md5sum == md5sum:
                return messages.describe_service(known)
        return 'its fields are not known here'

    def close(self) -> None:
        """Close the connections of a persistent service; a later call opens them again."""
        for connection in self._take_idle():
            connection.close()

    def __repr__(self) -> str:
        type_ = self.type if self._told else 'of a type not told yet'
        return f'<Service {self.name} {type_} at {self.uri}>'


class _Silent(ServiceCallError):
    """The provider has not answered in time."""


class _HandshakeRefused(Exception):
    """Refused in the handshake: the md5sum does not fit, or another node is at the provider's old
    address by now."""
