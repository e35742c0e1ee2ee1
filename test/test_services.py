"""Services: offered by a node with a block, and called by name alone."""
import contextlib
import io
import os
import socket
import threading

import pytest
import rosgraph.network
import std_srvs.srv

from helpers import create, speak_tcpros_only
from pharos.testing import TIMEOUT
import pharos
from pharos.private_rospy.process_rospy import rospy
from programs import run

SPAWN = 'turtlesim/Spawn'  # x, y, theta, name -> name
SET_BOOL = 'std_srvs/SetBool'  # data -> success, message
SET_BOOL_MD5SUM = std_srvs.srv.SetBool._md5sum


def call_here(master, service, /, **fields):
    """The way of this package: from node to node of this process."""
    return master.lookup_service(service, '/caller').call(**fields)


def call_through_tcp(master, service, /, **fields):
    """The way of any other ROS node."""
    with speak_tcpros_only(create(master, '/caller')) as caller:
        service_class = master.lookup_service(service, '/caller').service_class
        return caller.ros.ServiceProxy(service, service_class)(**fields)


both_ways = pytest.mark.parametrize('call', [call_here, call_through_tcp], ids=['here', 'tcp'])


# -- offered


@both_ways
@pytest.mark.parametrize(
    'block',
    [
        lambda request: pharos.service_class(SET_BOOL)._response_class(
            success=request.data, message='done'
        ),
        lambda request: {'success': request.data, 'message': 'done'},
        lambda request: (request.data, 'done'),
        lambda request: [request.data, 'done'],
    ],
    ids=['a response', 'a dict', 'a tuple', 'a list'],
)
def test_a_block_returns_a_response_or_its_fields(master, call, block):
    create(master, '/provider').serve('/set', SET_BOOL, block)
    response = call(master, '/set', data=True)
    assert (response.success, response.message) == (True, 'done')


@both_ways
@pytest.mark.parametrize(
    'block',
    [
        lambda request: request.name + '!',
        lambda request: {'name': request.name + '!'},
        lambda request: (request.name + '!',),
    ],
    ids=['the field', 'a dict', 'a tuple'],
)
def test_a_block_returns_the_only_field(master, call, block):
    create(master, '/provider').serve('/spawn', SPAWN, block)
    assert call(master, '/spawn', name='bob').name == 'bob!'


@both_ways
@pytest.mark.parametrize('value', [['a', 'b'], ('a', 'b'), [['a', 'b']], (('a', 'b'),)], ids=repr)
def test_an_only_field_that_is_an_array_may_be_in_a_list_as_rospy_has_it(master, call, value):
    create(master, '/provider').serve('/list', 'roscpp/GetLoggers', lambda request: nested(value))
    assert [each.name for each in call(master, '/list').loggers] == ['a', 'b']


def nested(value):
    """The value with messages in the place of texts."""
    if isinstance(value, str):
        return pharos.message_class('roscpp/Logger')(name=value)
    return type(value)(map(nested, value))


@both_ways
def test_a_falsy_value_is_the_only_field_too(master, call):
    create(master, '/provider').serve('/spawn', SPAWN, lambda request: '')
    assert call(master, '/spawn', name='bob').name == ''


@both_ways
@pytest.mark.parametrize('value', [None, {}, 7], ids=repr)
def test_what_a_block_returns_as_an_empty_response_does_not_matter(master, call, value):
    create(master, '/provider').serve('/clear', 'std_srvs/Empty', lambda request: value)
    assert call(master, '/clear') == std_srvs.srv.EmptyResponse()


def test_fields_that_a_dict_leaves_out_have_their_defaults(master):
    create(master, '/provider').serve('/set', SET_BOOL, lambda request: {'success': True})
    assert call_here(master, '/set').message == ''


@both_ways
def test_the_block_gets_the_request(master, call):
    got = []
    create(master, '/provider').serve('/spawn', SPAWN, lambda request: got.append(request) or '')
    call(master, '/spawn', x=1.0, y=2, name='bob')
    (request,) = got
    assert (request.x, request.y, request.theta, request.name) == (1.0, 2.0, 0.0, 'bob')
    assert request._connection_header['callerid'] == '/caller'


@both_ways
@pytest.mark.parametrize(
    'value, said',
    [
        (None, r'must return .* its fields \(success: bool, message: string\); it returned None'),
        (True, r'must return a response, a dict, tuple or list of its fields .* it returned True'),
        (
            (True,),
            r'a std_srvs/SetBool, must return .*it returned \(True,\), of length 1 and not 2',
        ),
        ([True, '', ''], r'block of /set, .* of length 3 and not 2'),
        ((7, 7), r'block of /set returned .*std_srvs/SetBoolResponse.message = 7 does not fit str'),
        ({'ok': True}, r'block of /set .*SetBoolResponse has no field .ok.*success: bool, mess'),
        ({'message': 7}, r'SetBoolResponse.message = 7 does not fit string'),
        (std_srvs.srv.EmptyResponse(), 'must return a response'),
    ],
    ids=repr,
)
def test_what_does_not_fit_is_an_error_at_both_ends(master, transcript, call, value, said):
    node = create(master, '/provider')
    node.serve('/set', SET_BOOL, lambda request: value)
    with pytest.raises((pharos.ServiceCallError, rospy.ServiceException), match=said):
        call(master, '/set')
    assert len(node.errors) == 1
    with pytest.raises(type(node.errors[0]), match=said):
        raise node.errors[0]


@both_ways
def test_an_exception_in_the_block_reaches_the_caller(master, transcript, call):
    node = create(master, '/provider')
    offered = node.serve('/spawn', SPAWN, no_room)
    with pytest.raises(
        (pharos.ServiceCallError, rospy.ServiceException), match='RuntimeError: no room for bob'
    ):
        call(master, '/spawn', name='bob')
    assert [str(error) for error in node.errors] == ['no room for bob']
    assert transcript == [
        'service /spawn no_room of /provider raised RuntimeError: no room for bob'
    ]
    offered.block = lambda request: 'room again'  # the node goes on
    assert call(master, '/spawn').name == 'room again'


def no_room(request):
    raise RuntimeError(f'no room for {request.name}')


def test_a_failed_call_is_a_service_call_error(master, transcript):
    create(master, '/provider').serve('/fail', 'std_srvs/Empty', lambda request: 1 / 0)
    service = master.lookup_service('/fail')
    with pytest.raises(pharos.ServiceCallError, match='/fail failed: .*division by zero'):
        service.call()
    assert service.response is None


def test_rosservice_knows_an_offered_service(master):
    node = create(master, '/provider')
    node.serve('/set', SET_BOOL, lambda request: {'success': True})
    assert '/set' in run(master.url, 'rosservice', 'list').stdout.split()
    assert run(master.url, 'rosservice', 'type', '/set').stdout.strip() == SET_BOOL
    assert run(master.url, 'rosservice', 'info', '/set').stdout.splitlines() == [
        'Node: /provider',
        'URI: rosrpc://127.0.0.1:%d' % node.tcp_port,
        'Type: ' + SET_BOOL,
        'Args: data',
    ]


def test_rosservice_calls_an_offered_service(master, transcript):
    node = create(master, '/provider')
    node.serve('/set', SET_BOOL, lambda request: {'success': request.data, 'message': 'done'})
    assert (
        run(master.url, 'rosservice', 'call', '/set', 'true').stdout
        == 'success: True\nmessage: "done"\n'
    )
    node.serve('/fail', 'std_srvs/Empty', lambda request: 1 / 0)
    failed = run(master.url, 'rosservice', 'call', '/fail')
    assert failed.returncode
    assert 'division by zero' in failed.stderr


def test_close_ends_the_offer(master):
    node = create(master, '/provider')
    offered = node.serve('/clear', 'std_srvs/Empty', lambda request: None)
    service = master.lookup_service('/clear')
    offered.close()
    offered.close()
    assert '/clear' not in master.services()
    assert '/provider/get_loggers' in master.services()
    with pytest.raises((pharos.ServiceCallError, pharos.UnknownServiceError), match='/clear'):
        service.call(timeout=TIMEOUT)
    node.serve('/clear', 'std_srvs/Empty', lambda request: None).close()  # the name is free


def test_a_node_offers_a_name_once(master):
    node = create(master, '/provider')
    node.serve('/clear', 'std_srvs/Empty', lambda request: None)
    with pytest.raises(
        pharos.PharosError, match='/provider offers /clear already: close that one first'
    ):
        node.serve('/clear', SET_BOOL, lambda request: None)
    assert call_here(master, '/clear') == std_srvs.srv.EmptyResponse()


def test_names_are_resolved_in_the_nodes_namespace(master):
    node = create(master, '/robot1/driver')
    names = [
        node.serve(name, 'std_srvs/Empty', lambda request: None).name
        for name in ('~halt', 'stop', '/all')
    ]
    assert names == ['/robot1/driver/halt', '/robot1/stop', '/all']
    assert set(names) <= set(master.services())
    remapped = create(master, '/other', argv=['stop:=/elsewhere'])
    assert remapped.serve('/stop', 'std_srvs/Empty', lambda request: None).name == '/elsewhere'


@pytest.mark.parametrize('block', [None, 7, lambda: None, lambda request, more: None])
def test_a_service_needs_a_block_of_one_argument(master, block):
    with pytest.raises(TypeError, match=r'block\(request\)'):
        create(master, '/provider').serve('/clear', 'std_srvs/Empty', block)
    assert '/clear' not in master.services()


def test_an_unknown_service_type(master):
    with pytest.raises(
        pharos.UnknownTypeError, match="unknown service type 'std_srvs/Emty'.*did you mean"
    ):
        create(master, '/provider').serve('/clear', 'std_srvs/Emty', lambda request: None)
    assert '/clear' not in master.services()


def test_services_come_back_with_their_node(master):
    node = create(master, '/provider')
    node.serve('/spawn', SPAWN, lambda request: request.name)
    service = master.lookup_service('/spawn')
    for name in 'ann', 'bob':
        node.stop()
        assert '/spawn' not in master.services()
        with pytest.raises((pharos.ServiceCallError, pharos.UnknownServiceError), match='/spawn'):
            service.call(name='nobody', timeout=TIMEOUT)
        node.start()
        assert service.call(name=name).name == name  # the same address again
        assert call_through_tcp(master, '/spawn', name=name).name == name


def test_a_service_is_the_newest_nodes_that_offers_it_and_the_olders_again_when_that_has_gone(
    master,
):
    def look_again():
        for node in newer, older:
            if node.is_running:
                node.latest_run.rospy.repair(
                    master.system_state(), False
                )  # as the watcher does every second
        return call_here(master, '/taken').message

    older, newer = create(master, '/older'), create(master, '/newer')
    for node in older, newer:
        node.serve('/taken', SET_BOOL, lambda request, name=node.name: {'message': name})
    assert [look_again(), look_again()] == ['/newer', '/newer']
    newer.stop()
    assert [look_again(), look_again()] == ['/older', '/older']


def test_a_closed_service_does_not_come_back(master):
    node = create(master, '/provider')
    node.serve('/clear', 'std_srvs/Empty', lambda request: None).close()
    node.stop()
    node.start()
    assert '/clear' not in master.services()


def test_a_service_that_is_closed_while_its_node_starts_again_does_not_come_back(master):
    node = create(master)
    channel = node.interested_in('/before', 'std_msgs/Empty')
    service = node.serve('/clear', 'std_srvs/Empty', lambda request: None)
    open_again = channel.open
    channel.open = lambda run: (open_again(run), service.close())
    for _ in range(2):
        node.stop()
        node.start()
        assert '/clear' not in master.services()


# -- called


def test_a_name_is_enough(master):
    create(master, '/provider').serve('/spawn', SPAWN, lambda request: request.name)
    service = master.lookup_service('/spawn', '/me')
    assert (service.name, service.caller_id, service.type) == ('/spawn', '/me', SPAWN)
    assert service.md5sum == '0b2d2e872a8e2887d5ed626f2bf2c561'
    assert service.uri.startswith('rosrpc://127.0.0.1:')
    assert service.response is None
    assert service.call(name='bob') is service.response


def test_a_block_and_keywords_fill_the_request(master):
    create(master, '/provider').serve(
        '/spawn', SPAWN, lambda request: f'{request.x:g} {request.y:g} {request.name}'
    )

    def fill(request):
        request.x, request.y = 1.0, 2.0

    service = master.lookup_service('/spawn')
    assert service.call(fill).name == '1 2 '
    assert service.call(fill, y=3.0, name='bob').name == '1 3 bob'


def test_an_unknown_service_names_the_near_ones(master):
    create(master, '/provider').serve('/turtle1/teleport', 'std_srvs/Empty', lambda request: None)
    with pytest.raises(
        pharos.UnknownServiceError,
        match='offers the service /turtle1/telport.*did you mean '
        './turtle1/teleport.*: see rosservice list',
    ):
        master.lookup_service('/turtle1/telport')


def test_a_service_of_nobody_that_answers(master):
    with socket.socket() as sock:
        sock.bind(('127.0.0.1', 0))
        dead = 'rosrpc://127.0.0.1:%d' % sock.getsockname()[1]
    master.api('/dead').registerService('/dead/clear', dead, 'http://127.0.0.1:1/')
    try:
        with pytest.raises(
            pharos.ServiceCallError, match=f'provider of /dead/clear at {dead} does not answer'
        ):
            master.lookup_service('/dead/clear')
    finally:
        master.api('/dead').unregisterService('/dead/clear', dead)


def test_an_md5sum_by_hand_is_what_is_sent(master):
    create(master, '/provider').serve('/set', SET_BOOL, lambda request: {'success': True})
    service = master.lookup_service('/set')
    service.md5sum = SET_BOOL_MD5SUM
    assert service.call().success
    service.md5sum = '*'  # ROS's own for "whatever it is"
    assert service.call().success
    service.md5sum = 'd41d8cd98f00b204e9800998ecf8427e'  # std_srvs/Empty
    with pytest.raises(pharos.ServiceTypeError) as error:
        service.call()
    for said in (
        '/set',
        SET_BOOL,
        service.md5sum,
        SET_BOOL_MD5SUM,
        'request: data: bool',
        'response: success: bool, message: string',
    ):
        assert said in str(error.value)
    service.md5sum = SET_BOOL_MD5SUM
    assert service.call().success


@pytest.mark.parametrize(
    'block, fields, said',
    [
        (None, {'nam': 'bob'}, 'turtlesim/SpawnRequest has no field .nam. .*did you mean .name.'),
        (
            None,
            {'x': 'far'},
            'turtlesim/SpawnRequest.x = .far. does not fit float32: give a number',
        ),
        (
            lambda request: setattr(request, 'x', 'far'),
            {},
            'turtlesim/SpawnRequest.x = .far. does not fit float32',
        ),
        (
            lambda request: setattr(request, 'nam', 'bob'),
            {},
            'turtlesim/SpawnRequest has no field .nam.',
        ),
    ],
)
def test_a_field_that_does_not_exist_or_does_not_fit(master, block, fields, said):
    called = []
    create(master, '/provider').serve('/spawn', SPAWN, lambda request: called.append(request) or '')
    with pytest.raises(pharos.MessageTypeError, match=said):
        master.lookup_service('/spawn').call(block, **fields)
    assert not called


def test_calls_of_several_threads_do_not_wait_for_each_other(master):
    together = threading.Barrier(3)
    create(master, '/provider').serve(
        '/meet', 'std_srvs/Trigger', lambda request: {'success': together.wait(TIMEOUT) >= 0}
    )
    service, answers = master.lookup_service('/meet'), []
    threads = [
        threading.Thread(target=lambda: answers.append(service.call().success), daemon=True)
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(TIMEOUT)
    assert answers == [True] * 3


@pytest.mark.parametrize('timeout', [None, TIMEOUT])
def test_a_service_calls_its_own_node_and_itself(master, timeout):
    def countdown(request):
        return (
            request.name
            if len(request.name) > 3
            else inner.call(name=request.name + '!', timeout=timeout).name
        )

    node = create(master, '/provider')
    node.serve('/spawn', SPAWN, countdown)
    inner = master.lookup_service('/spawn')
    assert inner.call(name='', timeout=timeout).name == '!!!!'


# -- time limits


class SilentProvider:
    """A provider at a real address: it tells its type, accepts a call, and never answers it."""

    def __init__(self, master, answer=b''):
        self._answer, self._taken = answer, []
        self._listening = socket.create_server(('127.0.0.1', 0))
        self.uri = 'rosrpc://127.0.0.1:%d' % self._listening.getsockname()[1]
        self._api = master.api('/silent')
        self._api.registerService('/silent/spawn', self.uri, 'http://127.0.0.1:1/')
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self):
        with contextlib.suppress(OSError):
            while True:
                connection = self._listening.accept()[0]
                self._taken.append(connection)
                header = rosgraph.network.read_ros_handshake_header(connection, io.BytesIO(), 4096)
                rosgraph.network.write_ros_handshake_header(
                    connection,
                    {
                        'callerid': '/silent',
                        'type': SPAWN,
                        'md5sum': '0b2d2e872a8e2887d5ed626f2bf2c561',
                        'request_type': SPAWN + 'Request',
                        'response_type': SPAWN + 'Response',
                    },
                )
                if header.get('probe') != '1':
                    connection.sendall(self._answer)

    def callers_gone(self):
        """Wait until all callers have closed their connections."""
        for connection in self._taken:
            connection.settimeout(TIMEOUT)
            # one that gives up may do so before it has read all, which resets the connection
            with contextlib.suppress(ConnectionResetError):
                while connection.recv(4096):
                    pass
        return True

    def close(self):
        self._api.unregisterService('/silent/spawn', self.uri)
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        self._thread.join(TIMEOUT)
        for connection in self._taken:
            connection.close()


@pytest.fixture
def silent(master, request):
    provider = SilentProvider(master, getattr(request, 'param', b''))
    yield provider
    provider.close()


def descriptors():
    return len(os.listdir('/proc/self/fd'))


def test_a_provider_that_never_answers_is_given_up(master, silent):
    """A call of rospy's has no time limit, and lasts for ever (ros_comm #152)."""
    service = master.lookup_service('/silent/spawn')
    assert silent.callers_gone()
    silent._taken.clear()
    before = set(threading.enumerate())
    for _ in range(3):
        with pytest.raises(
            pharos.ServiceCallError, match='/silent/spawn did not answer in time.*longer timeout='
        ):
            service.call(timeout=0.05)
    assert silent.callers_gone()
    assert service.response is None
    assert set(threading.enumerate()) <= before


@pytest.mark.parametrize(
    'silent',
    [b'\x01', b'\x01\x08\x00\x00\x00\x04\x00'],
    indirect=True,
    ids=['within the length', 'within the response'],
)
def test_a_provider_that_stops_in_the_middle_is_given_up(master, silent):
    with pytest.raises(pharos.ServiceCallError, match='did not answer in time'):
        master.lookup_service('/silent/spawn').call(timeout=0.05)
    assert silent.callers_gone()


@pytest.mark.parametrize('silent', [b'\x01\xff\xff\xff\xff'], indirect=True)
def test_a_response_of_4_gib_is_refused(master, silent):
    with pytest.raises(pharos.ServiceCallError, match='/silent/spawn .*4294967295 bytes'):
        master.lookup_service('/silent/spawn').call(timeout=TIMEOUT)


@pytest.mark.parametrize('silent', [b'\x00\x07\x00\x00\x00no room'], indirect=True)
def test_the_reason_of_a_provider_elsewhere_is_told(master, silent):
    with pytest.raises(pharos.ServiceCallError, match='/silent/spawn failed: no room'):
        master.lookup_service('/silent/spawn').call(timeout=TIMEOUT)


def test_a_time_limit_holds_for_a_block_of_this_process(master):
    release, node = threading.Event(), create(master, '/provider')
    node.serve('/wait', 'std_srvs/Trigger', lambda request: {'success': release.wait(TIMEOUT)})
    service = master.lookup_service('/wait')
    with pytest.raises(pharos.ServiceCallError, match='/wait did not answer in time'):
        service.call(timeout=0.05)
    release.set()
    assert service.call(timeout=TIMEOUT).success
    node.stop()
    assert [
        thread.name for thread in threading.enumerate() if thread.name.startswith('/provider')
    ] == []


def test_many_calls_leave_no_descriptor(master):
    create(master, '/provider').serve('/spawn', SPAWN, lambda request: request.name)
    service = master.lookup_service('/spawn')
    service.call()
    before = descriptors()
    for _ in range(200):
        service.call(timeout=TIMEOUT)
    assert descriptors() <= before + 5  # the master of the tests is in this process, too
