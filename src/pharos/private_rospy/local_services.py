"""rospy's Services, as the nodes of this process offer them and call each other's."""
import functools
import math
import queue
import socket
import sys
import time
import weakref

from pharos.intraprocess.copier import copier_for
from pharos.intraprocess.services import Failed, LocalService
from pharos.intraprocess.sharing import numbered
from pharos.private_rospy.connections import local_nodes
from pharos.private_rospy.lifetime import Interruption
from pharos.private_rospy.names import Resolved
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.registration import registered
from pharos.signals import is_from_signal


def find(name, uri, service_class, md5sum):
    """The service of that name and URI, to be called with that class, if its provider is of this
    process; else None.

    :param md5sum: what the caller says that the class has; what does not fit is left to the wire
    """
    node, service = _offered_here(name, uri)
    if service is None or not service.service_class._md5sum == md5sum == service_class._md5sum:
        return None
    return RospyService(node, service, service_class)


def class_of(name, uri):
    """The service class of that name and URI, if its provider is of this process; else None."""
    _, service = _offered_here(name, uri)
    return service and service.service_class


def _offered_here(name, uri):
    """The PrivateRospy and the rospy Service of that name and URI, or twice None."""
    for node in local_nodes():
        service = node.service_manager.map.get(name)
        if service is not None and service.uri == uri:
            return node, service
    return None, None


def offer(node, name, service_class, answer, timeout):
    """A rospy Service of that node.

    :param timeout: seconds that the master may take
    :raises MasterUnreachableError: if it cannot be registered
    """
    return registered(
        lambda: node.module.Service(Resolved(name), service_class, answer),
        lambda service: service.shutdown('it is not registered'),
        timeout,
    )


class RospyService(LocalService):
    """A rospy Service of this process, called without a socket.

    :param node: its PrivateRospy
    :param wanted: the caller's service class
    """

    def __init__(self, node, service, wanted):
        super().__init__(service.service_class, wanted)
        self._node, self._service, self._offered = node, service, node.service_manager.map
        self._freeze_response = copier_for(service.response_class).freeze
        self._run = functools.partial(node.start_thread, name='service')
        #: that of the responses, as TCPROS would bring it
        self.header = service.protocol.get_header_fields()

    def is_offered(self, uri):
        """Whether it is still offered, at that URI, as far as is known without asking the
        master."""
        service, name = self._service, self._service.resolved_name
        return (
            service.uri == uri
            and self._offered.get(name) is service
            and name not in self._node.services_of_others
        )

    def answer(self, request):
        """What rospy's ServiceImpl._handle_request does, but for the writing."""
        service = self._service
        try:
            response = self._node.module.impl.tcpros_service.convert_return_to_response(
                service.handler(request), service.response_class
            )
            service.seq += 1
            return self._freeze_response(numbered(response, service.seq))
        # the caller gets the text alone, as from elsewhere: the reason's traceback is its node's to
        # report
        except rospy.ServiceException as error:
            raise Failed(f'service cannot process request: {error}') from None
        except BaseException as error:
            if is_from_signal(error):
                raise
            self._tell_handler(error)
            raise Failed(f'error processing request: {error}') from None

    def _tell_handler(self, error):
        try:
            self._service.error_handler(error, *sys.exc_info())
        except BaseException as another:
            if is_from_signal(another):
                raise
            self._node.warn(
                f'the error handler of {self._service.resolved_name} raised {another!r}'
            )

    def keep_thread(self):
        """Have one thread run all that :meth:`run_until` is given, as TCPROS has one for each
        persistent connection; it ends with this object."""
        jobs = queue.SimpleQueue()
        self._run = jobs.put
        self._node.start_thread(_work, (jobs, self._node), 'service')
        weakref.finalize(self, jobs.put, None)

    def run_until(self, deadline, job):
        """Run it in a thread of the provider's; one that is stuck is not waited for."""
        outcome = queue.SimpleQueue()

        def work():
            try:
                outcome.put((job(), None))
            except BaseException as error:
                outcome.put((None, error))

        stopped = ConnectionAbortedError('its node stopped')
        if self._node.ended.is_set():
            raise stopped
        with Interruption(lambda: outcome.put((None, stopped)), self._node.lifetime):
            self._run(work)
            limit = None if deadline == math.inf else max(0.0, deadline - time.monotonic())
            try:
                response, error = outcome.get(timeout=limit)
            except queue.Empty:
                raise socket.timeout('time is up') from None
        if error is not None:
            raise error
        return response

    def call(self, frozen, header, deadline):
        """See :meth:`LocalService.call`; the response has the header that TCPROS would bring."""
        response = super().call(frozen, header, deadline)
        response._connection_header = self.header
        return response


def _work(jobs, node):
    with Interruption(lambda: jobs.put(None), node.lifetime):
        while not node.ended.is_set():
            job = jobs.get()
            if job is None:
                return
            job()
            del job  # it holds the service
