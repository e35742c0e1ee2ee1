"""Services: offered with a block, found by name, called from this process and from others."""
import concurrent.futures
import functools
import os
import signal
import socket
import subprocess
import threading

import genpy
import psutil
import pytest
import rosgraph
import rospy
import std_srvs.srv

import helpers
from helpers import PYTHON, TIMEOUT, create, registrations
import pharos
from pharos import Node, ServiceCallError, UnknownServiceError
from pharos.testing import Mailbox, until

EMPTY = 'std_srvs/Empty'
SET = 'std_srvs/SetBool'  # data -> success, message
SPAWN = 'turtlesim/Spawn'  # x, y, theta, name -> name
LIST = 'nodelet/NodeletList'  # -> nodelets, an array
SET_MD5SUM = std_srvs.srv.SetBool._md5sum
OTHER_MD5SUM = std_srvs.srv.Empty._md5sum
FAILED = ServiceCallError, UnknownServiceError, rospy.ServiceException, RuntimeError  # the peer's
needs_mux = pytest.mark.skipif(
    not os.path.exists('/usr/lib/topic_tools/mux'), reason='needs topic-tools'
)
# what a peer offers to all tests, and how it calls
PEER = '''
import pharos, std_srvs.srv

def serve(name, block):
    """Offer a SetBool; the block takes the request and returns (success, message)."""
    return rospy.Service(name, std_srvs.srv.SetBool, block)

def fail(request):
    raise RuntimeError('no room for bob')

def call(name, type_, fields):
    """Call it with rospy's ServiceProxy; returns the fields of the response."""
    response = rospy.ServiceProxy(name, pharos.service_class(type_))(**fields)
    return [getattr(response, field) for field in response.__slots__]

services = [
    serve('/there/not', lambda request: (not request.data, request._connection_header['callerid'])),
    serve('/there/fail', fail),
]
'''
pool = concurrent.futures.ThreadPoolExecutor()


network, master, peer = helpers.network, helpers.network_master, helpers.network_peer


@pytest.fixture
def node(master):
    """A node that offers services."""
    return create(master, '/provider')


@pytest.fixture(params=['Service', 'ServiceProxy', 'persistent', 'peer'])
def call(request, master):
    """Call a service in each way; returns the fields of the response as a list."""
    if request.param == 'peer':
        peer = request.getfixturevalue('peer')
        return lambda name, type_, /, **fields: peer.value(f'call({name!r}, {type_!r}, {fields!r})')

    def call_here(name, type_, /, **fields):
        if request.param == 'Service':
            answer = master.lookup_service(name, '/caller').call
        else:
            class_, persistent = pharos.service_class(type_), request.param == 'persistent'
            answer = caller.ros.ServiceProxy(name, class_, persistent)
        response = answer(**fields)
        return [getattr(response, field) for field in response.__slots__]

    caller = create(master, '/caller') if request.param != 'Service' else None
    return call_here


def answer_set(request):
    return {'success': request.data, 'message': 'done'}


# -- offered


@pytest.mark.parametrize(
    'type_, value, fields',
    [
        (SET, std_srvs.srv.SetBoolResponse(True, 'done'), [True, 'done']),
        (SET, {'success': True, 'message': 'done'}, [True, 'done']),
        (SET, {'success': True}, [True, '']),
        (SET, (True, 'done'), [True, 'done']),
        (SET, [True, 'done'], [True, 'done']),
        (SPAWN, 'bob', ['bob']),
        (SPAWN, '', ['']),
        (SPAWN, ['bob'], ['bob']),
        (LIST, [['a', 'b']], [['a', 'b']]),
        (EMPTY, None, []),
    ],
)
def test_block_returns_response_or_fields(master, node, type_, value, fields):
    node.serve('/gives', type_, lambda request: value)
    response = master.lookup_service('/gives').call()
    assert [getattr(response, field) for field in response.__slots__] == fields


@pytest.mark.parametrize('value', [None, (True,), (7, 7), {'no_such_field': 1}], ids=repr)
def test_unfit_result_fails_at_both_ends(master, node, value):
    node.serve('/set', SET, lambda request: value)
    with pytest.raises(ServiceCallError, match='/set'):
        master.lookup_service('/set').call()
    assert len(node.errors) == 1


def test_block_gets_request_and_caller(node, call):
    got = []
    node.serve('/spawn', SPAWN, lambda request: got.append(request) or '')
    call('/spawn', SPAWN, x=1.0, y=2, name='bob')
    (request,) = got
    assert (request.x, request.y, request.theta, request.name) == (1.0, 2.0, 0.0, 'bob')
    assert request._connection_header['callerid'] in ('/caller', '/peer')


def test_raising_block_reaches_caller_and_errors(node, call):
    def block(request):
        if not request.data:
            raise RuntimeError('no room for bob')
        return True, ''

    node.serve('/set', SET, block)
    with pytest.raises(FAILED, match='ServiceException|no room for bob'):
        call('/set', SET, data=False)
    assert [str(error) for error in node.errors] == ['no room for bob']
    assert call('/set', SET, data=True) == [True, '']  # the node goes on


@pytest.mark.parametrize(
    'verb, code, said',
    [('call', 2, ['division by zero']), ('info', 0, ['/provider', EMPTY, 'rosrpc://'])],
)
def test_rosservice_understands_service(master, node, verb, code, said):
    node.serve('/divide', EMPTY, lambda request: 1 / 0)
    ended = subprocess.run(
        [PYTHON, '/usr/bin/rosservice', verb, '/divide'],
        env={**os.environ, 'ROS_MASTER_URI': master.url},
        capture_output=True,
        text=True,
        timeout=2 * TIMEOUT,
    )
    assert ended.returncode == code
    assert [part for part in said if part not in ended.stdout + ended.stderr] == []


@pytest.mark.parametrize(
    'asked, name',
    [('~halt', '/robot/driver/halt'), ('stop', '/robot/stop'), ('/all', '/all'), ('/a', '/b')],
)
def test_service_name_is_resolved(master, asked, name):
    driver = create(master, '/robot/driver', argv=['/a:=/b'])
    driver.serve(asked, SET, lambda request: (True, name))
    assert name in master.services()
    assert master.lookup_service(name).call().message == name
    assert driver.lookup_service(asked).call().message == name


def test_node_serves_a_name_once(master, node):
    node.serve('/set', SET, lambda request: (True, 'first'))
    with pytest.raises(pharos.PharosError, match='/provider.*/set'):
        node.serve('/set', SET, lambda request: (True, 'second'))
    assert master.lookup_service('/set').call().message == 'first'


def test_newest_node_answers_taken_name(master, node):
    node.serve('/set', SET, lambda request: (True, 'older'))
    create(master, '/newer').serve('/set', SET, lambda request: (True, 'newer'))
    assert master.lookup_service('/set').call().message == 'newer'


def test_stop_closes_and_start_reopens(master, node, call):
    node.serve('/set', SET, answer_set)
    before = master.lookup_service('/set')
    node.stop()
    assert registrations(master, node.name) == [[], [], []]
    for use in functools.partial(call, '/set', SET), before.call:
        with pytest.raises(FAILED):
            use()
    node.start()
    assert call('/set', SET, data=True) == [True, 'done']
    assert before.call(data=True).success


class Driver(Node):
    """A node that offers a method of its own."""

    def start(self):
        super().start()
        self.serve('~greet', SPAWN, self.greet)

    def greet(self, request):
        return f'hello {request.name}'


def test_service_of_start_outlives_restart(master):
    driver = create(master, '/driver', Driver)
    driver.restart()
    assert master.lookup_service('/driver/greet').call(name='bob').name == 'hello bob'


# -- called

both_providers = pytest.mark.parametrize('name', ['/there/not', '/here/set'])


@both_providers
def test_provider_tells_type_and_md5sum(master, node, name):
    node.serve('/here/set', SET, answer_set)
    service = master.lookup_service(name, caller_id='/my_id')
    assert (service.name, service.caller_id, service.type) == (name, '/my_id', SET)
    assert service.md5sum == SET_MD5SUM
    assert service.uri.startswith('rosrpc://')


@both_providers
def test_response_of_last_call_is_kept(master, node, name):
    node.serve('/here/set', SET, answer_set)
    service = master.lookup_service(name)
    assert service.response is None
    first = service.call(data=True)
    assert service.response is first
    assert service.call(data=False) is service.response is not first


def test_caller_id_reaches_provider_elsewhere(master, node):
    assert master.lookup_service('/there/not', '/my_id').call().message == '/my_id'
    assert node.lookup_service('/there/not').call().message == node.name
    proxy = node.ros.ServiceProxy('/there/not', std_srvs.srv.SetBool, persistent=True)
    assert [proxy(data).success for data in (True, False)] == [False, True]
    assert proxy().message == node.name
    proxy.close()


def test_block_and_keywords_fill_request(master, node):
    def fill(request):
        request.x, request.y = 1.0, 2.0

    node.serve('/spawn', SPAWN, lambda request: f'{request.x:g} {request.y:g} {request.name}')
    service = master.lookup_service('/spawn')
    assert service.call(fill).name == '1 2 '
    assert service.call(y=3.0, name='bob').name == '0 3 bob'
    assert service.call(fill, name='bob').name == '1 2 bob'


@pytest.mark.parametrize(
    'block, fields, said',
    [
        (None, {'dat': True}, 'dat'),
        (None, {'data': 'yes'}, 'data'),
        (lambda request: setattr(request, 'data', 'yes'), {}, 'data'),
    ],
)
def test_wrong_field_is_told_before_call(master, node, block, fields, said):
    called = []
    node.serve('/here/set', SET, called.append)
    for name in '/here/set', '/there/fail':
        with pytest.raises(pharos.MessageTypeError, match=said):
            master.lookup_service(name).call(block, **fields)
    assert called == []


def test_unknown_service_raises_its_error(master, node):
    for lookup, name in (master.lookup_service, '/no_such'), (node.lookup_service, '~no_such'):
        with pytest.raises(UnknownServiceError, match='/no_such'):
            lookup(name)


@both_providers
def test_wrong_md5sum_is_answered_with_all(master, node, name):
    node.serve('/here/set', SET, answer_set)
    service = master.lookup_service(name)
    service.md5sum = OTHER_MD5SUM
    with pytest.raises(pharos.ServiceTypeError) as caught:
        service.call()
    for said in name, SET, SET_MD5SUM, OTHER_MD5SUM, 'data', 'success', 'message':
        assert said in str(caught.value)
    service.md5sum = SET_MD5SUM
    service.call()


def test_other_definition_here_is_refused(master, peer):
    text = 'int32 {}\nint32 {}\n---\nint32 difference\n'
    peer.run(
        f"cls = pharos.define_service('other_srvs/Subtract', {text.format('a', 'b')!r})\n"
        "subtract = rospy.Service('/subtract', cls, lambda request: request.a - request.b)"
    )
    defined = pharos.define_service('other_srvs/Subtract', text.format('b', 'a'))
    with pytest.raises(pharos.ServiceTypeError, match='/subtract.*other_srvs/Subtract') as caught:
        master.lookup_service('/subtract').call(a=9, b=1)
    assert defined._md5sum in str(caught.value)


def test_service_of_unknown_type_is_told(master, peer):
    peer.run(
        "cls = pharos.define_service('far_srvs/Add', 'int32 a\\n---\\nint32 b\\n')\n"
        "far = rospy.Service('/far', cls, lambda request: request.a + 1)"
    )
    with pytest.raises(pharos.UnknownTypeError, match='far_srvs/Add'):
        master.lookup_service('/far').call()
    pharos.define_service('far_srvs/Add', 'int32 a\n---\nint32 b\n')
    assert master.lookup_service('/far').call(a=1).b == 2


def connections_to(node):
    """The connections of this process to a node's TCPROS port."""
    connections = psutil.Process().connections('tcp')
    return [each for each in connections if each.raddr and each.raddr.port == node.tcp_port]


@pytest.mark.parametrize('served_by', ['serve', 'ros.Service'])
def test_call_in_process_needs_no_socket(master, node, served_by):
    found, class_ = [], std_srvs.srv.Trigger
    serve = node.serve if served_by == 'serve' else node.ros.Service
    serve('/trigger', class_, lambda request: (not found.append(connections_to(node)), ''))
    answer = master.lookup_service('/trigger').call
    until(lambda: not connections_to(node))  # that of the look-up
    assert [answer().success for _ in range(3)] == [True] * 3
    assert found == [[]] * 3


@pytest.mark.parametrize('is_persistent', [False, True])
def test_proxy_of_rospy_needs_no_socket(mortal, is_persistent):
    """A ServiceProxy calls a service of this process without the master, and fails as in rospy."""
    provider, caller = create(mortal.master, '/provider'), create(mortal.master, '/caller')

    def answer(request):
        if request.data:
            raise ValueError('not true')
        return True, request._connection_header['callerid']

    provider.ros.Service('/switch', std_srvs.srv.SetBool, answer)
    switch = caller.ros.ServiceProxy('/switch', std_srvs.srv.SetBool, persistent=is_persistent)
    mortal.end()
    assert switch(False).message == '/caller'
    text = r"service \[/switch\] responded with an error: b'error processing request: not true'"
    with pytest.raises(rospy.ServiceException, match=text):
        switch(True)
    with pytest.raises(TypeError):
        switch(1, 2)


def test_service_here_shares_neither_request_nor_response(master, node):
    kept = std_srvs.srv.SetBoolResponse(True, 'kept')

    def answer(request):
        request.data = False
        return kept

    node.ros.Service('/set', std_srvs.srv.SetBool, answer)
    request = std_srvs.srv.SetBoolRequest(True)
    response = create(master, '/caller').ros.ServiceProxy('/set', std_srvs.srv.SetBool)(request)
    assert request.data and response == kept and response is not kept


def test_proxy_calls_the_newest_node(master):
    for text in 'old', 'new':
        create(master, f'/{text}').serve('/set', SET, lambda request, text=text: (True, text))
    proxy = create(master, '/caller').ros.ServiceProxy('/set', std_srvs.srv.SetBool)
    assert proxy().message == 'new'


def test_proxy_calls_the_service_of_its_master(master):
    answers = []
    with pharos.Master.embedded() as other:
        masters = {'one': master, 'other': other}
        for text, each in masters.items():
            create(each, '/server').serve('/set', SET, lambda request, text=text: (True, text))
        for each in masters.values():
            proxy = create(each, '/caller').ros.ServiceProxy('/set', std_srvs.srv.SetBool)
            answers.append(proxy().message)
        for each in list(other.own_nodes()):
            each.stop()
    assert answers == ['one', 'other']


def test_service_here_that_exits_fails_its_call_alone(master, node):
    """In rospy the thread of the service ends, and the caller goes on."""
    node.ros.Service('/exit', std_srvs.srv.Empty, lambda request: exit('the motor is off'))
    with pytest.raises(rospy.ServiceException, match='the motor is off'):
        create(master, '/caller').ros.ServiceProxy('/exit', std_srvs.srv.Empty)()
    node.serve('/set', SET, answer_set)
    assert node.is_running and master.lookup_service('/set').call(data=True).success


def test_proxy_of_another_type_fails_as_in_rospy(master, node):
    node.ros.Service('/set', std_srvs.srv.SetBool, lambda request: (True, ''))
    caller = create(master, '/caller')
    with pytest.raises(rospy.ServiceException, match='md5sum'):
        caller.ros.ServiceProxy('/set', std_srvs.srv.Trigger)()
    with pytest.raises(genpy.SerializationError, match='data is not a bool'):
        caller.ros.ServiceProxy('/set', std_srvs.srv.SetBool)('true')


def test_sleep_after_a_call_here_is_the_callers(master, node):
    """The stop of the caller's node ends its sleep as any other, and the soul goes on."""
    texts, sleeps = [], threading.Event()
    node.serve('/set', SET, answer_set)

    def work(me):
        me.ros.ServiceProxy('/set', std_srvs.srv.SetBool)(True)
        sleeps.set()
        me.ros.rostime.wallsleep(3600)
        texts.append('woke')

    node.fork(work)
    assert sleeps.wait(TIMEOUT)
    node.stop()
    assert texts == ['woke']


# -- waits and time limits


@pytest.mark.parametrize('who, timeout', [('master', None), ('node', None), ('node', TIMEOUT)])
def test_service_is_waited_for(master, node, who, timeout):
    waiting = master if who == 'master' else create(master, '/waiting')
    waits = pool.submit(waiting.wait_for_service, 'late', timeout)
    node.serve('/late', SET, answer_set)
    assert waits.result(TIMEOUT).call(data=True).success


@pytest.mark.parametrize('timeout', [0, 0.1])
def test_wait_ends_after_its_timeout(master, node, timeout):
    for waiting in master, node:
        with pytest.raises(UnknownServiceError, match='/never'):
            waiting.wait_for_service('/never', timeout)


def test_rospy_waits_for_service(master, node):
    wait = create(master, '/caller').ros.wait_for_service
    with pytest.raises(rospy.ROSException):
        wait('/set', timeout=0.05)
    waits = pool.submit(wait, '/set', TIMEOUT)
    node.serve('/set', SET, answer_set)
    assert waits.result(TIMEOUT) is None


def test_timeout_ends_call_to_hanging_process(master, peer):
    service = master.lookup_service('/there/not')
    os.kill(peer.pid, signal.SIGSTOP)
    try:
        with pytest.raises(ServiceCallError, match='/there/not'):
            service.call(timeout=0.1)
    finally:
        os.kill(peer.pid, signal.SIGCONT)
    assert service.call(timeout=TIMEOUT).success


def test_timeout_holds_for_block_here(master, node):
    ends = threading.Event()
    node.serve('/wait', SET, lambda request: (ends.wait(TIMEOUT), ''))
    service = master.lookup_service('/wait')
    with pytest.raises(ServiceCallError, match='/wait'):
        service.call(timeout=0.1)
    ends.set()
    assert service.call(timeout=TIMEOUT).success


def test_timeout_is_for_the_whole_call(master, node):
    """Each byte of the response comes in time, the last one never."""
    node.serve('/drips', SET, answer_set)
    service = master.lookup_service('/drips')
    node.stop()
    given_up = threading.Event()
    header = b'callerid=/drips', b'type=std_srvs/SetBool', f'md5sum={SET_MD5SUM}'.encode()

    def drip(listening):
        packed = b''.join(len(each).to_bytes(4, 'little') + each for each in header)
        with listening.accept()[0] as connection:
            connection.sendall(len(packed).to_bytes(4, 'little') + packed + b'\x01\xff\0\0\0')
            while not given_up.wait(0.02):
                connection.sendall(b'x')

    with socket.create_server(('127.0.0.1', 0)) as listening:
        address = f'rosrpc://127.0.0.1:{listening.getsockname()[1]}'
        api = rosgraph.Master('/drips', master_uri=master.url)
        api.registerService('/drips', address, 'http://127.0.0.1:1/')
        dripped = pool.submit(drip, listening)
        with pytest.raises(ServiceCallError, match='/drips'):
            service.call(timeout=0.3)
        given_up.set()
        api.unregisterService('/drips', address)
        dripped.exception(TIMEOUT)


# -- providers that go


def test_moved_service_is_found_again(master, node, peer):
    node.serve('/moves', SET, lambda request: (True, 'here'))
    service = master.lookup_service('/moves')
    assert service.call().message == 'here'
    peer.run("moves = serve('/moves', lambda request: (True, 'there'))")
    node.stop()
    assert service.call().message == 'there'
    create(master, '/next').serve('/moves', SET, lambda request: (True, 'here again'))
    peer.run('moves.shutdown()')
    assert service.call().message == 'here again'


def test_stop_ends_call_under_way(master, node):
    called, ends = threading.Event(), threading.Event()
    node.serve('/wait', SET, lambda request: called.set() or (ends.wait(TIMEOUT), ''))
    waits = pool.submit(master.lookup_service('/wait').call, timeout=TIMEOUT)
    assert called.wait(TIMEOUT)
    stops = pool.submit(node.stop)
    assert isinstance(waits.exception(TIMEOUT), ServiceCallError)  # the block has not returned
    ends.set()
    assert stops.result(TIMEOUT) is None


# -- several at once


@pytest.mark.parametrize('timeout', [None, TIMEOUT])
def test_calls_run_side_by_side(master, node, timeout):
    together = threading.Barrier(3)
    node.serve('/meet', SET, lambda request: (together.wait(TIMEOUT) >= 0, ''))
    service = master.lookup_service('/meet')
    calls = [pool.submit(service.call, timeout=timeout) for _ in range(3)]
    assert [each.result(TIMEOUT).success for each in calls] == [True] * 3


@pytest.mark.parametrize('where', ['here', 'there'])
def test_each_thread_gets_its_own_answers(master, node, peer, where):
    if where == 'here':
        node.serve('/here/echo', SPAWN, lambda request: request.name)
    else:
        class_ = f'pharos.service_class({SPAWN!r})'
        peer.run(f"rospy.Service('/there/echo', {class_}, lambda request: request.name)")
    service = master.lookup_service(f'/{where}/echo')

    def ask(number):
        return [service.call(name=f'{number} {turn}').name for turn in range(10)]

    expected = [[f'{number} {turn}' for turn in range(10)] for number in range(4)]
    assert list(pool.map(ask, range(4), timeout=TIMEOUT)) == expected


def test_calls_leave_no_descriptor(master):
    service, process = master.lookup_service('/there/not'), psutil.Process()
    service.call()
    before = process.num_fds()
    for _ in range(30):
        service.call(timeout=TIMEOUT)
    until(lambda: process.num_fds() <= before + 5)  # the master is in this process


@pytest.mark.parametrize('timeout', [None, TIMEOUT])
@pytest.mark.parametrize('start', ['thread', 'delegate'])
def test_cycle_of_services_does_not_deadlock(master, node, timeout, start):
    """Two nodes call each other until the name is long enough."""
    other = create(master, '/other')

    def ask(caller, to, name):
        return caller.lookup_service(to).call(name=name, timeout=timeout).name

    def block(caller, to, request):
        return ask(caller, to, request.name + '!') if len(request.name) < 4 else request.name

    node.serve('/first', SPAWN, functools.partial(block, node, '/second'))
    other.serve('/second', SPAWN, functools.partial(block, other, '/first'))
    if start == 'thread':
        assert ask(node, '/first', '') == '!!!!'
        return

    def answer(message, channel):
        node.send_to('/answers', data=ask(node, '/first', message.data))

    answers = Mailbox(other, '/answers', 'std_msgs/String')
    node.interested_in('/ask', 'std_msgs/String', answer)
    other.send_to('/ask', data='go')
    assert answers.next().data == 'go!!'


# -- C++


@needs_mux
def test_roscpp_service_is_called(master):
    pharos.define_service('topic_tools/MuxList', '---\nstring[] topics\n')
    pharos.define_service('topic_tools/MuxAdd', 'string topic\n---\n')
    with master.run('topic_tools', 'mux', '/mux_out', '/mux_a', '/mux_b') as mux:
        master.wait_for_service('/mux/add', TIMEOUT).call(topic='/mux_c', timeout=TIMEOUT)
        topics = master.wait_for_service('/mux/list', TIMEOUT)
        assert topics.type == 'topic_tools/MuxList'
        assert topics.call().topics == ['/mux_a', '/mux_b', '/mux_c']
        os.kill(mux.pid, signal.SIGINT)  # unlike a kill, it unregisters
        mux.wait(TIMEOUT)


@needs_mux
@pytest.mark.parametrize('topic, code', [('front', 0), ('broken', 1)])
def test_roscpp_program_calls_node(master, node, topic, code):
    pharos.define_service('topic_tools/MuxSelect', 'string topic\n---\nstring prev_topic\n')
    answers = {'front': 'back'}
    node.serve('/ours_select', 'topic_tools/MuxSelect', lambda request: answers[request.topic])
    with master.run('topic_tools', 'switch_mux', '/ours', topic) as client:
        assert client.wait(TIMEOUT) == code
    assert len(node.errors) == code


# -- a stop in a call

SLOW_SERVER = '''
from std_srvs.srv import Trigger
def serve(request):
    say('called')
    {sleep}
    return True, 'done'
rospy.init_node('program')
rospy.Service('/slow', Trigger, serve)
rospy.spin()
'''
CALLER = '''
import threading
from std_srvs.srv import Trigger
def call(tell):
    rospy.wait_for_service('/slow')
    try:
        tell(rospy.ServiceProxy('/slow', Trigger)().message)
    except rospy.ServiceException:
        tell('failed')
'''


@pytest.mark.parametrize(
    'client, sleep',
    [
        ('same process', 'rospy.sleep(3600)'),
        ('same process', 'time.sleep(3600)'),
        ('same process', 'threading.Event().wait(1)'),
        ('other process', 'rospy.sleep(3600)'),
        ('other process', 'time.sleep(3600)'),
    ],
)
def test_stop_in_a_call_is_no_success(master, bench, peer, client, sleep):
    script = bench.load(SLOW_SERVER.format(sleep=sleep))
    if client == 'same process':
        begin = "rospy.init_node('client')\ncall(say)\n"
        master.load(bench.write(f'{CALLER}{begin}', 'client'))
    else:
        peer.run(f'{CALLER}told = []\ndef say(text): told.append(text)\n')
        peer.run('threading.Thread(target=call, args=[say], daemon=True).start()')
    until(lambda: bench.said() == ['called'])
    script.stop()
    told = bench.said if client == 'same process' else lambda: ['called', *peer.value('told')]
    until(lambda: len(told()) > 1)
    assert told() == ['called', 'failed']


def test_stop_ends_call_of_soul(master, node, peer):
    peer.run(
        'from std_srvs.srv import Empty\ncalled = []\n'
        "hang = rospy.Service('/hang', Empty, lambda request: called.append(1) or rospy.sleep(3600))"
    )
    node.stop_timeout = TIMEOUT
    thread = node.fork(lambda me: me.wait_for_service('/hang', TIMEOUT).call())
    until(lambda: peer.value('called'))
    stopping = threading.Thread(target=node.stop, daemon=True)
    stopping.start()
    stopping.join(TIMEOUT / 3)
    assert not stopping.is_alive() and not thread.is_alive()
