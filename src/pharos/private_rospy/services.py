"""Service calls between nodes of one process: without a socket, otherwise as over TCPROS."""
import queue
import socket
import sys

from pharos.private_rospy import copier
from pharos.private_rospy.host import rospy
from pharos.private_rospy.wiring import running_here


class Failed(Exception):
    """The provider failed; the text is what TCPROS would bring."""


def find(name, uri):
    """The rospy Service of that name and URI, with its PrivateRospy, if it is of this process; else None."""
    for instance in running_here():
        service = instance.service(name)
        if service is not None and service.uri == uri:
            return service, instance
    return None


def call(found, request, caller_id, timeout):
    """Call what :func:`find` found; request and response are the receiver's own.

    :param timeout: seconds; None: no limit, and the service runs in this thread
    :raises Failed: if the service fails
    :raises socket.timeout: if it does not answer in time; it goes on in a thread of its node
    """
    service, instance = found
    request = _copy(request)
    request._connection_header = {'service': service.resolved_name, 'md5sum': service.service_class._md5sum,
                                  'callerid': caller_id}
    if timeout is None:
        return _answer(service, instance, request)
    answer = instance.workers.run(lambda: _answer(service, instance, request), timeout)
    if isinstance(answer, Failed):
        raise answer
    return answer


class Workers:
    """Threads of a node that answer calls with a time limit; one that is stuck is not waited for."""

    def __init__(self, start_thread):
        self._start_thread = start_thread
        self._idle = []    # a queue of each thread that has nothing to do
        self._closed = False

    def run(self, job, timeout):
        """What ``job()`` returns, or the Failed that it raises.

        :raises socket.timeout: after ``timeout`` seconds
        """
        try:
            jobs = self._idle.pop()
        except IndexError:
            jobs = queue.SimpleQueue()
            self._start_thread(self._work, (jobs,), 'service')
        outcome = queue.SimpleQueue()
        jobs.put((job, outcome))
        try:
            return outcome.get(timeout=max(0.0, timeout))
        except queue.Empty:
            raise socket.timeout('time is up') from None

    def _work(self, jobs):
        while not self._closed:
            job, outcome = jobs.get()
            if job is None:
                return
            try:
                result = job()
            except Failed as failure:
                result = failure
            self._idle.append(jobs)    # before the caller goes on, who may call again at once
            outcome.put(result)

    def close(self):
        """End the threads; nothing is run any more."""
        self._closed = True
        while self._idle:
            self._idle.pop().put((None, None))


def _answer(service, instance, request):
    """What rospy's ServiceImpl._handle_request does, but for the writing."""
    try:
        return _copy(instance.as_response(service.handler(request), service.response_class))
    except rospy.ServiceException as error:
        raise Failed('service cannot process request: %s' % error) from error
    except Exception as error:
        service.error_handler(error, *sys.exc_info())
        raise Failed('error processing request: %s' % error) from error


def _copy(message):
    each = copier.copier_for(type(message))
    return each.thaw(each.freeze(message))
