"""Service calls between nodes of one process: without a socket, otherwise as over TCPROS."""
import queue
import socket
import sys
import threading
import time

from pharos.intraprocess import copier
from pharos.private_rospy.process_rospy import rospy
from pharos.private_rospy.lifetime import Interruption
from pharos.private_rospy.names import Resolved
from pharos.private_rospy.registration import registered
from pharos.intraprocess.sharing import numbered
from pharos.private_rospy.connections import local_nodes
from pharos.signals import is_from_signal

# service calls of one thread within one another: a cycle, which would only end with the stack
NESTED = 64
IDLE = 1.0  # seconds that a thread with nothing to do is kept

_nested = threading.local()  # .depth: of the calls that run in this thread


class Failed(Exception):
    """The provider failed; the text is what TCPROS would bring."""


def find(name, uri, service_class):
    """The :class:`LocalService` of that name and URI, if its provider is of this process; else
    None."""
    instance, service = _offered_here(name, uri)
    return service and LocalService(instance, service, service_class)


def class_of(name, uri):
    """The service class of that name and URI, if its provider is of this process; else None."""
    _, service = _offered_here(name, uri)
    return service and service.service_class


def _offered_here(name, uri):
    """The PrivateRospy and the rospy Service of that name and URI, or twice None."""
    for instance in local_nodes():
        service = instance.services.get(name)
        if service is not None and service.uri == uri:
            return instance, service
    return None, None


def offer(instance, name, service_class, answer):
    """A rospy Service of that node.

    :raises MasterUnreachableError: if it cannot be registered
    """
    return registered(
        lambda: instance.rospy.Service(Resolved(name), service_class, answer),
        lambda service: service.shutdown('it is not registered'),
    )


class LocalService:
    """A rospy Service of this process, called without a socket.

    :param service_class: whose requests and responses the caller has; that of the service may be
        another one
    """

    def __init__(self, instance, service, service_class):
        self._instance, self._service = instance, service
        self._offered, self._as_response = instance.services, instance.as_response
        self._name, self._uri = service.resolved_name, service.uri
        self.md5sum = service.service_class._md5sum
        self._header = {
            'service': self._name,
            'type': service.service_class._type,
            'md5sum': self.md5sum,
            'callerid': instance.name,
        }
        #: the first half of copying a request; raises what ``request.serialize()`` raises
        self.freeze = copier.copier_for(service_class._request_class).freeze
        self._freeze_response = copier.copier_for(service.response_class).freeze
        self._thaw = copier.thawer(service_class._request_class, service.request_class)
        self._thaw_response = copier.thawer(service.response_class, service_class._response_class)

    def is_offered(self, uri):
        """Whether it is still offered, at that URI."""
        return self._uri == uri and self._offered.get(self._name) is self._service

    def call(self, frozen, header, deadline):
        """Call it with a request that :attr:`freeze` made; returns the response.

        :param header: the request's ``_connection_header``
        :param deadline: by ``time.monotonic()``; None: no limit, and the service runs in this
            thread
        :raises Failed: if the service fails
        :raises ConnectionError: if its node stops meanwhile
        :raises socket.timeout: if it does not answer in time; it goes on in a thread of its node
        """
        depth = getattr(_nested, 'depth', 0) + 1
        if depth > NESTED:
            raise Failed(
                '%d service calls are under way within one another: do the services call each other'
                ' in a circle?' % NESTED
            )
        request = self._thaw(frozen)
        request._connection_header = header
        if deadline is None:
            answer = self._answer(request, depth)
        else:
            answer = self._instance.workers.run(lambda: self._answer(request, depth), deadline)
        response = self._thaw_response(answer)
        response._connection_header = dict(self._header)
        return response

    def _answer(self, request, depth):
        """What rospy's ServiceImpl._handle_request does, but for the writing: the response,
        frozen."""
        service = self._service
        before, _nested.depth = getattr(_nested, 'depth', 0), depth
        try:
            response = self._as_response(service.handler(request), service.response_class)
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
        finally:
            _nested.depth = before

    def _tell_handler(self, error):
        try:
            self._service.error_handler(error, *sys.exc_info())
        except BaseException as another:
            if is_from_signal(another):
                raise
            self._instance.warn(f'the error handler of {self._name} raised {another!r}')


def serialize(request):
    """The request's bytes; raises what ``request.serialize()`` raises."""
    return copier.serialized(request)


def checker(cls):
    """The function that raises what ``serialize()`` of a message of that class would raise; cheaper
    than that."""
    return copier.copier_for(cls).freeze


class Workers:
    """Threads of a node that answer calls with a time limit; one that is stuck is not waited
    for."""

    def __init__(self, start_thread):
        self._start_thread = start_thread
        self._idle = []  # a queue of each thread that has nothing to do
        self._waited_for = set()  # the queues in which callers expect an outcome
        self._closed = False

    def run(self, job, deadline):
        """What ``job()`` returns, or the Failed that it raises.

        :raises socket.timeout: at the deadline
        :raises ConnectionError: if the node stops
        """
        outcome = queue.SimpleQueue()
        self._waited_for.add(outcome)
        try:
            if self._closed:
                raise _stopped()
            self._give(job, outcome)
            with Interruption(lambda: outcome.put(_stopped())):
                result = outcome.get(timeout=max(0.0, deadline - time.monotonic()))
        except queue.Empty:
            raise socket.timeout('time is up') from None
        finally:
            self._waited_for.discard(outcome)
        if isinstance(result, Exception):
            raise result
        return result

    def _give(self, job, outcome):
        try:
            jobs = self._idle.pop()
        except IndexError:
            jobs = queue.SimpleQueue()
            self._start_thread(self._work, (jobs,), 'service')
        jobs.put((job, outcome))

    def _work(self, jobs):
        while not self._closed:
            job, outcome = self._next(jobs)
            if job is None or self._closed:
                return
            try:
                result = job()
            except Failed as failure:
                result = failure
            except BaseException as error:
                # of what makes the answer; this thread and its caller go on
                result = Failed(f'error processing request: {type(error).__name__}')
            self._idle.append(jobs)  # before the caller goes on, who may call again at once
            outcome.put(result)
            job = outcome = result = None  # they are not this thread's to keep alive

    def _next(self, jobs):
        try:
            return jobs.get(timeout=IDLE)
        except queue.Empty:
            try:
                self._idle.remove(jobs)
                return None, None
            except ValueError:
                return jobs.get()  # somebody has just taken it, to put a job in

    def close(self):
        """End the threads and the waits; nothing is run any more."""
        self._closed = True
        for outcome in tuple(self._waited_for):
            outcome.put(_stopped())
        while self._idle:
            self._idle.pop().put((None, None))


def _stopped():
    return ConnectionAbortedError('its node stopped')
