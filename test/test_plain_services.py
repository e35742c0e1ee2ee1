"""rospy's ServiceProxy: to a provider of this process without a socket, to its users as over TCPROS."""
import contextlib
import threading

import genpy
import geometry_msgs.msg
import nav_msgs.srv
import pytest
import rospy
import std_srvs.srv

from helpers import create, ended, in_thread, speak_tcpros_only
from pharos.testing import Mailbox, TIMEOUT, until

SET, EMPTY, PLAN = std_srvs.srv.SetBool, std_srvs.srv.Empty, nav_msgs.srv.GetPlan


@pytest.fixture(params=['INTRAPROCESS', 'TCPROS'])
def pair(request, master):
    """A node that calls and one that serves, and whether the calls go through a socket."""
    nodes = create(master, '/asking'), create(master, '/serving')
    nodes[1].has_socket = request.param == 'TCPROS'
    if nodes[1].has_socket:
        for node in nodes:
            speak_tcpros_only(node)
    return nodes


@pytest.fixture(params=[False, True], ids=['plain', 'persistent'])
def persistent(request):
    return request.param


def served(node, name, service_class, handler, **kwargs):
    """A plain Service of the node; the name of it."""
    node.ros.Service(name, service_class, handler, **kwargs)
    return name


def refused(proxy, *arguments, error=rospy.ServiceException):
    """What the call raises says."""
    with pytest.raises(error) as caught:
        proxy(*arguments)
    return str(caught.value)


def test_a_call_opens_no_socket_to_a_provider_of_this_process(pair, persistent, monkeypatch):
    asking, serving = pair
    name = served(serving, '/plain/set', SET, lambda request: (request.data, 'done'))
    accepted = []
    server = serving.latest_run.rospy.module.impl.tcpros_base._tcpros_server
    handler = server.service_connection_handler
    monkeypatch.setattr(
        server,
        'service_connection_handler',
        lambda *arguments: accepted.append(arguments) or handler(*arguments),
    )
    proxy = asking.ros.ServiceProxy(name, SET, persistent=persistent)
    for _ in range(3):
        assert proxy(True) == std_srvs.srv.SetBoolResponse(True, 'done')
    assert len(accepted) == ((1 if persistent else 3) if serving.has_socket else 0)


def test_request_and_response_are_each_sides_own_and_have_headers(pair, persistent):
    asking, serving = pair
    requests, response = [], PLAN._response_class()
    response.plan.poses = [geometry_msgs.msg.PoseStamped()]
    name = served(
        serving, '/plain/plan', PLAN, lambda request: requests.append(request) or response
    )
    proxy = asking.ros.ServiceProxy(name, PLAN, persistent, headers={'who': 'me'})
    request = PLAN._request_class(tolerance=1)
    got = proxy(request)
    assert got == response
    assert got is not response
    assert got.plan.poses[0] is not response.plan.poses[0]
    assert requests[0] is not request
    assert type(requests[0].tolerance) is float
    header = {'service': name, 'callerid': '/asking', 'md5sum': PLAN._md5sum, 'who': 'me'}
    assert requests[0]._connection_header == {
        **header,
        **({'persistent': '1'} if persistent else {}),
    }
    assert got._connection_header == {
        'service': name,
        'callerid': '/serving',
        'md5sum': PLAN._md5sum,
        'type': 'nav_msgs/GetPlan',
    }


def raises(error):
    def handler(request):
        raise error

    return handler


@pytest.mark.parametrize(
    'handler, said',
    [
        (raises(ValueError('spoilt')), "b'error processing request: spoilt'"),
        (raises(SystemExit(3)), "b'error processing request: 3'"),
        (raises(rospy.ServiceException('no')), "b'service cannot process request: no'"),
        (
            lambda request: None,
            "b'service cannot process request: service handler returned None'",
        ),
        (lambda request: (1, 2, 3), 'returned wrong number of values'),
        (lambda request: (True, 5), 'error processing request'),
    ],
    ids=['raises', 'exits', 'refuses', 'none', 'too many', 'unfit'],
)
def test_a_provider_that_fails_says_why(pair, handler, said):
    asking, serving = pair
    name = served(serving, '/plain/failing', SET, handler, error_handler=lambda *error: None)
    text = refused(asking.ros.ServiceProxy(name, SET), True)
    assert text.startswith(f'service [{name}] responded with an error: ')
    assert said in text


def test_an_error_handler_hears_of_what_the_handler_raised(pair):
    asking, serving = pair
    heard = Mailbox()
    name = served(
        serving,
        '/plain/heard',
        EMPTY,
        raises(ValueError('spoilt')),
        error_handler=lambda error, kind, value, traceback: heard(kind, None),
    )
    refused(asking.ros.ServiceProxy(name, EMPTY))
    assert heard.next() is ValueError


def test_a_request_that_does_not_serialize_is_refused_and_the_next_is_not(pair):
    asking, serving = pair
    name = served(serving, '/plain/unfit', PLAN, lambda request: PLAN._response_class())
    proxy = asking.ros.ServiceProxy(name, PLAN)
    request = PLAN._request_class(tolerance='much')
    refused(proxy, request, error=genpy.SerializationError)
    assert proxy() == PLAN._response_class()


def test_wrong_arguments_are_told_as_rospy_tells_them(pair):
    asking, serving = pair
    name = served(serving, '/plain/arguments', SET, lambda request: (True, ''))
    proxy = asking.ros.ServiceProxy(name, SET)
    assert 'Invalid number of arguments' in refused(proxy, 1, 2, error=TypeError)
    assert 'expected [bool] but got' in refused(proxy, std_srvs.srv.EmptyRequest(), error=TypeError)


def test_another_type_and_a_missing_provider_are_told_as_rospy_tells_them(pair, persistent):
    asking, serving = pair
    name = served(serving, '/plain/typed', SET, lambda request: (True, ''))
    text = refused(asking.ros.ServiceProxy(name, EMPTY, persistent))
    assert text.startswith('unable to connect to service: remote error reported: request from')
    assert 'md5sums do not match' in text
    text = refused(asking.ros.ServiceProxy('/plain/missing', EMPTY, persistent))
    assert text == 'service [/plain/missing] unavailable'


def test_a_provider_that_comes_late_is_waited_for(pair):
    asking, serving = pair
    proxy, waited = asking.ros.ServiceProxy('/plain/late', SET), Mailbox()

    def wait():
        proxy.wait_for_service(TIMEOUT)
        waited(proxy(True), None)

    thread = in_thread(wait)
    served(serving, '/plain/late', SET, lambda request: (True, 'late'))
    assert waited.next().message == 'late'
    assert ended(thread)
    with pytest.raises(rospy.ROSException, match='timeout exceeded while waiting for service'):
        asking.ros.wait_for_service('/plain/never', 0.01)


def test_a_provider_that_goes_and_comes_again(pair, persistent):
    asking, serving = pair
    service = serving.ros.Service('/plain/again', SET, lambda request: (True, 'first'))
    proxy = asking.ros.ServiceProxy('/plain/again', SET, persistent)
    assert proxy(True).message == 'first'
    service.shutdown()
    if persistent:  # its connection is served on
        assert proxy(True).message == 'first'
    else:
        assert refused(proxy, True) == 'service [/plain/again] unavailable'
        served(serving, '/plain/again', SET, lambda request: (True, 'second'))
        assert proxy(True).message == 'second'


def test_a_service_that_another_node_takes_is_that_nodes(pair, master):
    asking, serving = pair
    served(serving, '/plain/taken', SET, lambda request: (True, 'first'))
    proxy = asking.ros.ServiceProxy('/plain/taken', SET)
    assert proxy(True).message == 'first'
    served(create(master, '/taking'), '/plain/taken', SET, lambda request: (True, 'second'))
    assert proxy(True).message == 'second'


def test_a_service_that_is_looked_up_once_is_another_nodes_when_that_takes_it(master):
    """It was called for ever where it had been."""
    served(create(master, '/serving'), '/plain/lost', SET, lambda request: (True, 'first'))
    service = master.lookup_service('/plain/lost')
    assert service.call(data=True).message == 'first'
    served(create(master, '/taking'), '/plain/lost', SET, lambda request: (True, 'second'))
    until(lambda: service.call(data=True).message == 'second')


@contextlib.contextmanager
def stuck_call(pair, persistent, **expected):
    """Within this, a call goes on; gives the Mailbox for what it says when it ends all the same."""
    asking, serving = pair
    entered, release, said = threading.Event(), threading.Event(), Mailbox()

    def stuck(request):
        entered.set()
        release.wait(TIMEOUT)
        return True, ''

    served(serving, '/plain/stuck', SET, stuck)
    proxy = asking.ros.ServiceProxy('/plain/stuck', SET, persistent)
    thread = in_thread(lambda: said(refused(proxy, True, **expected), None))
    assert entered.wait(TIMEOUT)
    yield said
    release.set()
    assert ended(thread)


def test_a_call_ends_when_the_provider_stops(pair, persistent):
    serving = pair[1]
    serving.stop_timeout = 0.1
    with stuck_call(pair, persistent) as said:
        stopping = in_thread(serving.stop)
        assert said.next().startswith(
            'transport error completing service call: unable to receive data'
        )
    assert ended(stopping)


def test_a_call_ends_when_the_caller_stops(pair, persistent):
    with stuck_call(pair, persistent, error=rospy.ROSInterruptException) as said:
        pair[0].stop()
        assert said.next() == 'node shutdown interrupted service call'


def test_calls_that_call_back_do_not_wait_for_each_other(pair):
    asking, serving = pair
    served(asking, '/plain/back', SET, lambda request: (request.data, 'back'))
    back = serving.ros.ServiceProxy('/plain/back', SET)
    served(serving, '/plain/there', SET, lambda request: back(request.data))
    with pytest.raises(rospy.ServiceException):  # a response of another instance is one
        asking.ros.ServiceProxy('/plain/there', EMPTY)()
    assert asking.ros.ServiceProxy('/plain/there', SET)(True).message == 'back'


def test_a_handler_runs_in_a_thread_of_its_node(pair):
    asking, serving = pair
    names = Mailbox()
    served(
        serving,
        '/plain/thread',
        EMPTY,
        lambda request: names(threading.current_thread().name, None) or {},
    )
    asking.ros.ServiceProxy('/plain/thread', EMPTY)()
    assert names.next().startswith('/serving ')


def test_a_closed_persistent_proxy_calls_no_more(pair):
    asking, serving = pair
    name = served(serving, '/plain/closed', SET, lambda request: (True, ''))
    proxy = asking.ros.ServiceProxy(name, SET, persistent=True)
    proxy(True)
    proxy.close()
    with pytest.raises(AttributeError):  # rospy's own way to say so
        proxy(True)


def test_no_thread_is_left_by_calls(pair, persistent):
    asking, serving = pair
    name = served(serving, '/plain/threads', SET, lambda request: (True, ''))
    before = {thread for thread in threading.enumerate()}
    proxy = asking.ros.ServiceProxy(name, SET, persistent)
    for _ in range(5):
        proxy(True)
    proxy.close()
    del proxy
    until(lambda: not {thread for thread in threading.enumerate()} - before)
