"""Services that a node offers; live/service_client.py calls those of any node."""
from __future__ import annotations

from contextlib import suppress

from rospy import ServiceException

from pharos import messages
from pharos.blocks import with_arguments
from pharos.channels import Endpoint
from pharos.errors import PharosError


class OfferedService(Endpoint):
    """A service that a node offers; made by :meth:`Node.serve`.

    :ivar name: the service's full name
    """

    def __init__(self, node, name, service_class, block):
        self.node = node
        self.name = name
        self.service_class = service_class
        self.delegate = with_arguments(block, 'block of a service', 1, 1)
        self.open()

    def _open(self) -> None:
        self._run.master.call('getPid')
        try:
            self.ros_object = self.node.ros.Service(self.name, self.service_class, self._answer)
        except ServiceException as error:
            raise PharosError(f'{self._run.name} offers {self.name} already: {error}') from None

    def _close(self) -> None:
        self.ros_object.shutdown()

    def _answer(self, request):
        try:
            value = self.delegate(request)
            return messages.response(self.service_class._response_class, value)
        except BaseException as error:
            role = f'service {self.name}'
            retry = self._answer_again
            self._run.report_failure(error, self.delegate, role, request, retry=retry)
            raise ServiceException(f'{type(error).__name__}: {error}') from error

    def _answer_again(self, request: object) -> None:
        with suppress(ServiceException):  # _answer() has reported it
            self._answer(request)
