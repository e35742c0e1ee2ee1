"""Answer calls of services; those of this process in the thread of the caller, without a socket."""
import io
from types import SimpleNamespace

from rospy import ServiceException

from pharos.intraprocess.copier import SERIALIZE_ERRORS, copy_of
from pharos.intraprocess.links import runs
from pharos.waiting import current


def find_service(name, master_url, uri=None):
    """Return the run and the rospy.Service of a node of this process by its name; Nones if there is none.

    :param uri: the service's URI; None: take the service of the node that has started last
    """
    for run in reversed(list(runs.values())):
        service = run.service_manager.get_service(name)
        if service and run.master.url == master_url and uri in (None, service.uri):
            return run, service
    return None, None


def answer(run, function, *arguments):
    """Call a function that answers a call of a service of a run; a stop of the run ends its sleeps."""
    former_run = current.service_run
    current.service_run = run
    try:
        function(*arguments)
    finally:
        current.service_run = former_run


def call_here(run, service, request, header):
    """Have a rospy.Service of a run of this process answer in this thread; return a copy of its response.

    :param request: the request, which the service may change
    :param header: the connection header that the service sees
    :raises ServiceException: if the service fails, or its node has stopped meanwhile
    """
    answers = []
    connection = SimpleNamespace(
        write_buff=io.BytesIO(),
        send_message=lambda response, seq: answers.append(copy_of(response)),
        # an error is a 0, four bytes of length, and the text
        write_data=lambda data: answers.append(ServiceException(data[5:].decode())),
    )
    request._connection_header = header
    try:
        answer(run, service._handle_request, connection, request)
    except SystemExit as error:  # ends the service's thread in rospy, and not the caller's
        raise ServiceException(f'the service ended: {error!r}') from None
    if run.finished.is_set():  # between processes the connection would be closed
        raise ServiceException(f'{run.name} has stopped')
    response = answers[0]
    if isinstance(response, Exception):
        raise response
    return response


def call_by_proxy(run, proxy, request):
    """Call the service of a rospy.ServiceProxy if a node of this process offers the same type.

    :param run: the run of the caller's node
    :returns: the response; None if the call must go by a socket
    :raises ServiceException: if the service fails
    """
    provider, service = find_service(proxy.resolved_name, run.master.url)
    is_same_type = service and service.response_class is proxy.response_class
    if not is_same_type or type(request) is not service.request_class:
        return None
    try:
        own_request = copy_of(request)
    except SERIALIZE_ERRORS:  # rospy's error names the field
        return None
    try:
        return call_here(provider, service, own_request, proxy.protocol.get_header_fields())
    except ServiceException as error:
        text = str(error).encode()  # as in rospy, which prints the bytes
        raise ServiceException(
            f'service [{proxy.resolved_name}] responded with an error: {text}'  # type: ignore
        ) from None
