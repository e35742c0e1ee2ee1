"""Call services of this process, in the thread of the caller and without a socket."""
import io
from types import SimpleNamespace

from rospy import ServiceException

from pharos.intraprocess.copier import SERIALIZE_ERRORS, copy_of
from pharos.intraprocess.links import runs


def find_service(name, master_url, uri=None):
    """Return the rospy.Service of a node of this process by its name, or None.

    :param uri: the service's URI; None: take the service of the node that has started last
    """
    for run in reversed(list(runs.values())):
        service = run.service_manager.get_service(name)
        if service and run.master.url == master_url and uri in (None, service.uri):
            return service
    return None


def call_here(service, request, header):
    """Have a rospy.Service of this process answer in this thread; return a copy of its response.

    :param request: the request, which the service may change
    :param header: the connection header that the service sees
    :raises ServiceException: if the service fails
    """
    answers = []
    connection = SimpleNamespace(
        write_buff=io.BytesIO(),
        send_message=lambda response, seq: answers.append(copy_of(response)),
        # an error is a 0, four bytes of length, and the text
        write_data=lambda data: answers.append(ServiceException(data[5:].decode())),
    )
    request._connection_header = header
    service._handle_request(connection, request)
    answer = answers[0]
    if isinstance(answer, Exception):
        raise answer
    return answer


def call_by_proxy(run, proxy, request):
    """Call the service of a rospy.ServiceProxy if a node of this process offers the same type.

    :param run: the run of the caller's node
    :returns: the response; None if the call must go by a socket
    :raises ServiceException: if the service fails
    """
    service = find_service(proxy.resolved_name, run.master.url)
    is_same_type = service and service.response_class is proxy.response_class
    if not is_same_type or type(request) is not service.request_class:
        return None
    try:
        own_request = copy_of(request)
    except SERIALIZE_ERRORS:  # rospy's error names the field
        return None
    try:
        return call_here(service, own_request, proxy.protocol.get_header_fields())
    except ServiceException as error:
        text = str(error).encode()  # as in rospy, which prints the bytes
        raise ServiceException(
            f'service [{proxy.resolved_name}] responded with an error: {text}'  # type: ignore
        ) from None
    except SystemExit as error:  # ends the service's thread in rospy, and not the caller's
        if run.stopping.is_set():
            raise
        raise ServiceException(f'service [{proxy.resolved_name}] ended: {error!r}') from None
