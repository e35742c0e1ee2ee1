"""Services that a node offers."""
import contextlib
import functools
import reprlib
from typing import TYPE_CHECKING, Any, Dict, Union

import genpy

from pharos import messages, signals
from pharos.blocks import Block, check_block, text_of
from pharos.errors import MessageTypeError, PharosError
from pharos.intraprocess.copier import copier_for
from pharos.private_rospy import local_services
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.deadlines import time_limit
from pharos.private_rospy.registration import UNREGISTER_TIMEOUT
from pharos.private_rospy.xmlrpc_server import is_call_from_nearby

if TYPE_CHECKING:
    from pharos.node import Node
    from pharos.run import Run


class OfferedService:
    """A service of a node; made by :meth:`~pharos.Node.serve`.

    :ivar node: the node that offers it
    :ivar name: its full name
    :ivar service_class: the class of its type
    :ivar closed: whether it was closed
    """

    def __init__(
        self,
        node: 'Node',
        name: str,
        typed_as: Union[str, type],
        block: Block,
        only_nearby: bool = False,
    ) -> None:
        self.node = node
        self.name = name
        self._only_nearby = only_nearby
        self.service_class = messages.service_class(typed_as)
        self._check = copier_for(self.service_class._response_class).freeze
        self.block = block
        self.closed = False  # whether close() was called
        self._service: Any = None  # rospy's, once it is open
        opened = node.current_run.opened
        if any(isinstance(other, OfferedService) and other.name == name for other in opened):
            raise self._is_offered()
        self.open(node.current_run)

    def open(self, run: 'Run') -> None:
        """Register with the master, also after a restart of the node.

        :param run: the node's that is to have it
        """
        try:
            service = local_services.offer(
                run.rospy,
                self.name,
                self.service_class,
                self._answer,
                self.node.connect_timeout,
            )
        except rospy.ServiceException as error:  # a plain rospy Service has the name
            raise self._is_offered() from error
        take = functools.partial(setattr, self, '_service', service)
        run.remember(self, self.name, take, lambda: service.shutdown('its node stopped'))
        if self.closed:  # meanwhile
            self.close()

    def _is_offered(self) -> PharosError:
        return PharosError(
            f'{self.node.name} offers {self.name} already: close that one first, or choose another'
            ' name'
        )

    def node_stopped(self) -> None:
        """The node stops, and its rospy closes all services."""

    @property
    def block(self) -> Block:
        """The block that answers, called as ``block(request)``; may be replaced, and takes effect
        with the next call."""
        return self._block

    @block.setter
    def block(self, block: Block) -> None:
        if block is None:
            raise TypeError(f'{self.name} needs a block that answers, called as block(request)')
        self._block = check_block(block, 'service block', ('request',))

    @property
    def type(self) -> str:
        """The type name, such as 'std_srvs/Empty'."""
        return str(self.service_class._type)

    def _answer(self, request: genpy.Message) -> genpy.Message:
        block = self.block
        if self._only_nearby and not is_call_from_nearby(self.node.master.url):
            why = f"{self.name} is for this host and the master's alone"
            self.node.log(f'{why}: refused to {request._connection_header["callerid"]}', 'warn')
            raise rospy.ServiceException(f'refused: {why}')
        try:
            return self._as_response(block(request))
        except BaseException as error:
            self.node.latest_run.report(
                error, block, f'service {self.name}', message=request, again=self._answer_again
            )
            why = f'{type(error).__name__}: {text_of(error)}'
            raise rospy.ServiceException(why) from error

    def _answer_again(self, request: genpy.Message) -> None:
        services = [
            opened
            for opened in self.node.current_run.opened
            if isinstance(opened, OfferedService)
            and (opened.name, opened.service_class) == (self.name, self.service_class)
        ]
        # the node may have closed this one, and offered it anew, as after a restart
        service = services[0] if services else self
        with contextlib.suppress(rospy.ServiceException):  # it is reported
            service._answer(request)

    def _as_response(self, value: Any) -> genpy.Message:
        """The response that the block meant: itself, its fields by name or in their order, or its
        only field."""
        response = self.service_class._response_class
        if isinstance(value, genpy.Message) and value._type == response._type:
            if value._md5sum != response._md5sum:  # the caller would read its bytes as other fields
                raise MessageTypeError(
                    f'{self.name} answers with a {response._type} of'
                    f' {messages.describe_fields(response)} [{response._md5sum}]; its block'
                    ' returned one of'
                    f' {messages.describe_fields(type(value))} [{value._md5sum}]: make it of'
                    ' the class that the service was offered with'
                )
            try:
                self._check(value)
            except Exception:
                messages.check_fits(value)  # tells what of it does not fit
            return value
        fields = value if isinstance(value, dict) else self._fields_in_order(value)
        try:
            return messages.fill(response(), fields)
        except MessageTypeError as error:
            raise MessageTypeError(
                f'the block of {self.name} returned what does not fit: {error}'
            ) from error

    def _fields_in_order(self, value: Any) -> Dict[str, Any]:
        """The fields of a response by their names, where the block returned their values, or the
        value of the only one."""
        response = self.service_class._response_class
        names = response.__slots__
        if not names:
            return {}
        is_sequence = isinstance(value, (list, tuple))
        if is_sequence and len(value) == len(names):
            # [[1, 2]], as rospy has it, or [1]: ROS has no arrays of arrays
            is_one_array = len(names) == 1 and response._slot_types[0].endswith(']')
            if not is_one_array or isinstance(value[0], (list, tuple, bytes)):
                return dict(zip(names, value))
        if len(names) == 1 and value is not None:
            return {names[0]: value}
        or_field = ' or its only field' if len(names) == 1 else ''
        length = f', of length {len(value)} and not {len(names)}' if is_sequence else ''
        raise TypeError(
            f'the block of {self.name}, a {self.type}, must return a response, a dict, tuple or list'
            f' of its fields ({messages.describe_fields(response)}){or_field}; it returned'
            f' {reprlib.repr(value)}{length}'
        )

    def close(self) -> None:
        """Offer it no longer. Harmless when done twice."""
        with signals.held():
            self.closed = True  # where it is only just being opened, it is closed right after that
            if self in self.node.latest_run.opened:
                self.node.latest_run.forget(self)
                with time_limit(UNREGISTER_TIMEOUT):
                    self._service.shutdown('closed')

    def __repr__(self) -> str:
        return f'<OfferedService {self.name} {self.type} of {self.node.name}>'
