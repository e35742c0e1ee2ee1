"""Service calls to providers of every kind: called by name alone, in time, from many threads, and
leaving nothing."""
import contextlib
import json
import os
import queue
import re
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest
import rosgraph
import rosnode

from helpers import InProcessMaster, create
from pharos.testing import TIMEOUT, until
import pharos
from pharos import messages
from programs import PROGRAMS, Program, environment, forget_parameters, run, script
from sockets import connections_to_port, wait_for_end

ECHO = 'diagnostic_msgs/AddDiagnostics'  # load_namespace -> success, message
ECHO_FIELDS = 'request: load_namespace: string; response: success: bool, message: string'

# Debian has topic_tools's programs, but neither its service files nor their Python classes.
MUX_TYPES = {
    'add': ('topic_tools/MuxAdd', 'string topic\n---\n'),
    'delete': ('topic_tools/MuxDelete', 'string topic\n---\n'),
    'list': ('topic_tools/MuxList', '---\nstring[] topics\n'),
    'select': ('topic_tools/MuxSelect', 'string topic\n---\nstring prev_topic\n'),
}


@contextlib.contextmanager
def provider(url, name, kind='rospy', port=0):
    """A provider in a process of its own, as a Program. However it ends, it leaves nothing on the
    master."""
    with Program(url, sys.executable, PROGRAMS / 'provider.py', kind, name, str(port)) as program:
        try:
            program.wait_for('ready')
            yield program
        finally:
            if program.process.poll() is not None:
                forget(url, name)


def forget(url, name):
    """What ``rosnode cleanup`` does with a node that has died."""
    with contextlib.suppress(rosnode.ROSNodeException):
        rosnode.cleanup_master_blacklist(rosgraph.Master('/test', master_uri=url), [name])


def kill(program):
    """As a crash or ``kill -9``: the provider stays registered."""
    program.process.kill()
    program.process.wait(TIMEOUT)


def hang(pid):
    """Stop a child of this process. It goes on accepting connections, which the kernel does for
    it."""
    os.kill(pid, signal.SIGSTOP)
    os.waitid(os.P_PID, pid, os.WSTOPPED)  # its threads may answer until then


@pytest.fixture(scope='module')
def there(ros_master):
    """A rospy provider in another process, /there, that lives through the tests of this file."""
    with provider(ros_master.url, '/there') as program:
        yield program


@pytest.fixture(scope='module')
def counted(ros_master):
    """A pharos provider in another process, /counted, of which nothing is wanted but answers."""
    with provider(ros_master.url, '/counted', 'pharos') as program:
        yield program


@pytest.fixture(scope='module')
def mux(ros_master):
    """A roscpp provider, topic_tools's mux between /calls/a and /calls/b."""
    for type_, text in MUX_TYPES.values():
        pharos.define_service(type_, text)
    master = pharos.Master(ros_master.url)
    with master.run(
        'topic_tools', 'mux', '/calls/out', '/calls/a', '/calls/b', remap={'__ns': '/calls'}
    ) as process:
        until(lambda: {'/calls/mux/' + name for name in MUX_TYPES} <= set(master.services()))
        yield process


@pytest.fixture
def threads_alternate():
    """Threads take turns as often as they can, so that what is not safe among them shows."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(before)


persistent_or_not = pytest.mark.parametrize(
    'persistent', [False, True], ids=['plain', 'persistent']
)


def echo(request):
    return {'success': True, 'message': request.load_namespace}


def started(job):
    """Run ``job()`` in a thread; returns a function that waits for what it returned or the error
    that it raised."""
    outcome = queue.SimpleQueue()

    def work():
        try:
            outcome.put(job())
        except BaseException as error:
            outcome.put(error)

    thread = threading.Thread(target=work, daemon=True)
    thread.start()

    def ended():
        value = outcome.get(timeout=TIMEOUT)
        thread.join(TIMEOUT)
        return value

    return ended


def together(count, job):
    """What ``job(0)``, ``job(1)`` ... returned or raised, run by as many threads at once."""
    begin = threading.Barrier(count)
    return [
        ended()
        for ended in [
            started(lambda number=number: begin.wait(TIMEOUT) >= 0 and job(number))
            for number in range(count)
        ]
    ]


def connections_to(service):
    """How many connections to the service's provider, another process, are open in this one."""
    return connections_to_port(int(service.uri.rpartition(':')[2]))


@contextlib.contextmanager
def nothing_left(service):
    """No connection to the service's provider, and no thread, is there after the block that was not
    before."""
    before = threads()
    assert connections_to(service) == 0
    yield
    assert connections_to(service) == 0
    assert threads() <= before


def threads():
    """Those of this process, but for the master's, which is here too and answers other
    processes."""
    return {
        thread for thread in threading.enumerate() if 'process_request_thread' not in thread.name
    }


# -- by name and keywords alone


@pytest.fixture(scope='module')
def simulator(ros_master, tmp_path_factory):
    folder = tmp_path_factory.mktemp('turtles')
    picture = f'_picture:={folder / "drive.png"}'
    with Program(ros_master.url, script('turtle_simulator'), picture, cwd=folder) as program:
        program.wait_for('Spawning turtle [turtle1]')
        program.wait_for('There is no window')
        yield program
    forget_parameters(ros_master.url)


def test_every_service_of_a_turtle_simulator_is_called_from_a_process_that_has_no_turtlesim(
    master, simulator
):
    done = run(master.url, sys.executable, PROGRAMS / 'all_turtle_services.py')
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() == [
        'called',
        'roscpp/GetLoggers',
        'roscpp/SetLoggerLevel',
        'std_srvs/Empty',
        'std_srvs/Empty',
        'std_srvs/Trigger',
        'turtlesim/Kill',
        *['turtlesim/SetPen'] * 2,
        'turtlesim/Spawn',
        *['turtlesim/TeleportAbsolute'] * 2,
        *['turtlesim/TeleportRelative'] * 2,
    ]


def test_a_service_whose_type_nobody_here_knows_tells_it_and_is_called_once_it_is_defined(
    master, simulator
):
    done = run(master.url, sys.executable, PROGRAMS / 'unknown_service_type.py')
    assert done.returncode == 0, done.stderr
    type_and_md5sum, unknown, wrong = done.stdout.splitlines()
    # turtlesim's own
    assert type_and_md5sum == 'turtlesim/TeleportAbsolute a130bc60ee6513855dc62ea83fcc5b20'
    assert "unknown service type 'turtlesim/TeleportAbsolute'" in unknown
    assert 'define_service(' in unknown
    assert 'request: x: float32, y: float32, theta: float32; response: no fields' in wrong


@persistent_or_not
def test_the_services_of_a_roscpp_node(master, mux, persistent):
    services = {
        name: master.lookup_service('/calls/mux/' + name, persistent=persistent)
        for name in MUX_TYPES
    }
    assert {name: service.type for name, service in services.items()} == {
        name: type_ for name, (type_, text) in MUX_TYPES.items()
    }
    try:
        services['select'].call(topic='/calls/a')
        services['add'].call(topic='/calls/c')
        assert services['list'].call().topics == ['/calls/a', '/calls/b', '/calls/c']
        assert services['select'].call(topic='/calls/c').prev_topic == '/calls/a'
        assert services['select'].call(topic='/calls/b').prev_topic == '/calls/c'
        services['delete'].call(lambda request: setattr(request, 'topic', '/calls/c'))
        assert services['list'].call().topics == ['/calls/a', '/calls/b']
        assert connections_to(services['list']) == (4 if persistent else 0)
    finally:
        for service in services.values():
            service.close()


@persistent_or_not
@pytest.mark.parametrize('timeout', [None, TIMEOUT])
def test_the_services_of_a_rospy_node(master, there, persistent, timeout):
    service = master.lookup_service('/there/echo', '/me', persistent)
    for name in 'ann', 'bob', '', 'ü' * 100000:
        assert service.call(load_namespace=name, timeout=timeout).message == name
        assert connections_to(service) == persistent
    assert service.response._connection_header['callerid'] == '/there'
    service.close()
    assert connections_to(service) == 0
    # close is no end
    assert service.call(load_namespace='again', timeout=timeout).message == 'again'
    service.close()


# -- what does not go, each an error of its own


def test_no_kind_of_failure_is_another():
    kinds = [
        pharos.UnknownServiceError,
        pharos.ServiceTypeError,
        pharos.ServiceCallError,
        pharos.MessageTypeError,
        pharos.UnknownTypeError,
        pharos.MasterUnreachableError,
    ]
    assert [kind.__bases__ for kind in kinds] == [(pharos.PharosError,)] * len(kinds)


@pytest.fixture(params=['rospy', 'roscpp', 'here'])
def any_provider(request):
    """``(service name, type, what is said of its fields)`` of providers of each kind.

    To be used before ``master``, which takes what starts after itself for left behind.
    """
    if request.param == 'roscpp':
        request.getfixturevalue('mux')
        return (
            '/calls/mux/select',
            'topic_tools/MuxSelect',
            'request: topic: string; response: prev_topic: string',
        )
    if request.param == 'rospy':
        request.getfixturevalue('there')
        return '/there/echo', ECHO, ECHO_FIELDS
    create(request.getfixturevalue('master'), '/here').serve('/here/echo', ECHO, echo)
    return '/here/echo', ECHO, ECHO_FIELDS


@persistent_or_not
def test_an_md5sum_set_by_hand_that_does_not_fit_is_answered_with_all_that_is_known(
    any_provider, master, persistent
):
    name, type_, fields = any_provider
    service = master.lookup_service(name, persistent=persistent)
    right = service.md5sum
    topic = {'topic': '/calls/a'} if 'topic' in fields else {}
    service.call(**topic)
    for wrong in 'd41d8cd98f00b204e9800998ecf8427e', 'typed in wrongly':
        service.md5sum = wrong  # sent, though a connection with the right one may be idle
        with pytest.raises(pharos.ServiceTypeError) as error:
            service.call(**topic, timeout=TIMEOUT)
        assert str(error.value) == (
            f'the md5sum {wrong!r} is not that of {name}, which is of type {type_} with md5sum '
            f'{right} ({fields}): set that one, or none'
        )
        assert service.response is None
    for fitting in right, '*', None:
        service.md5sum = fitting
        service.call(**topic, timeout=TIMEOUT)
    service.close()
    assert connections_to(service) == 0


@pytest.mark.parametrize('moves', [False, True], ids=['at the same address', 'elsewhere'])
def test_a_provider_that_came_back_with_another_type(master, moves):
    node = create(master, '/changes')
    offered = node.serve('/calls/set', 'std_srvs/SetBool', lambda request: {'success': True})
    service = master.lookup_service('/calls/set')
    offered.close()
    (create(master, '/other') if moves else node).serve(
        '/calls/set', 'std_srvs/Trigger', lambda request: {}
    )
    with pytest.raises(
        pharos.ServiceTypeError,
        match='/calls/set, which is of type std_srvs/Trigger .*request: no fields.*'
        'it was std_srvs/SetBool when it was looked up: look it up again',
    ):
        service.call(data=True, timeout=TIMEOUT)
    assert master.lookup_service('/calls/set').call().message == ''


def test_a_slip_in_the_name_of_a_service_elsewhere(master, there):
    with pytest.raises(
        pharos.UnknownServiceError, match='the service /there/ecko .did you mean ./there/echo'
    ):
        master.lookup_service('/there/ecko')


@persistent_or_not
def test_a_rospy_provider_that_fails_says_why(master, there, persistent):
    service = master.lookup_service('/there/fail', persistent=persistent)
    for _ in range(3):
        with pytest.raises(pharos.ServiceCallError, match='/there/fail failed: .*no room for bob'):
            service.call(load_namespace='bob')
    assert service.response is None and connections_to(service) == persistent  # it lives
    service.close()


@persistent_or_not
def test_a_roscpp_provider_that_fails_says_nothing(master, mux, persistent):
    service = master.lookup_service('/calls/mux/select', persistent=persistent)
    service.call(topic='/calls/a')
    with pytest.raises(
        pharos.ServiceCallError, match='/calls/mux/select failed: its provider gives no reason'
    ):
        service.call(topic='/calls/nowhere')
    assert service.call(topic='/calls/b').prev_topic == '/calls/a'
    service.close()


@pytest.mark.parametrize(
    'block, fields, said',
    [
        (
            None,
            {'load_namespaces': 'x'},
            'AddDiagnosticsRequest has no field .load_namespaces. .*did you mean',
        ),
        (
            None,
            {'load_namespace': 7},
            'AddDiagnosticsRequest.load_namespace = 7 does not fit string: give a str',
        ),
        (
            lambda request: setattr(request, 'load_namespace', 7),
            {},
            'load_namespace = 7 does not fit string',
        ),
        (
            lambda request: setattr(request, 'name', 'x'),
            {},
            'AddDiagnosticsRequest has no field .name.',
        ),
    ],
    ids=['a name', 'a value', 'a value, by a block', 'a name, by a block'],
)
def test_a_wrong_field_is_told_before_a_provider_elsewhere_is_called(
    master, there, block, fields, said
):
    service = master.lookup_service('/there/wait')
    with nothing_left(service), pytest.raises(pharos.MessageTypeError, match=said):
        service.call(block, timeout=TIMEOUT, **fields)  # its block would not return


@persistent_or_not
def test_a_provider_that_was_killed_is_gone_and_one_that_was_cleaned_up_is_unknown(
    master, persistent
):
    with provider(master.url, '/mortal') as program:
        service = master.lookup_service('/mortal/echo', persistent=persistent)
        assert service.call(load_namespace='ann').message == 'ann'
        kill(program)
        with pytest.raises(
            pharos.ServiceCallError, match=f'/mortal/echo at {service.uri} .*refused.*still running'
        ):
            service.call(load_namespace='bob')
        with pytest.raises(
            pharos.ServiceCallError, match='/mortal/echo .*does not answer .*rosnode cleanup'
        ):
            master.lookup_service('/mortal/echo')
        forget(master.url, '/mortal')
        with pytest.raises(pharos.UnknownServiceError, match='/mortal/echo'):
            service.call(load_namespace='bob')
        assert connections_to(service) == 0


# -- time limits


@persistent_or_not
def test_a_block_elsewhere_that_does_not_return_is_given_up_and_its_late_answer_is_nobodys(
    master, there, persistent
):
    gate = master.lookup_service('/there/gate')
    gate.call(data=False)
    service = master.lookup_service('/there/wait', persistent=persistent)
    with nothing_left(service):
        for number in range(3):
            with pytest.raises(pharos.ServiceCallError, match='/there/wait did not answer in time'):
                service.call(load_namespace='early', timeout=1.0)
            there.wait_for('called by early')
    gate.call(data=True)
    assert service.call(load_namespace='late', timeout=TIMEOUT).message == 'late'
    service.close()


@persistent_or_not
@pytest.mark.parametrize('kind', ['rospy', 'roscpp'])
def test_a_process_that_hangs_is_given_up_and_called_again_once_it_goes_on(
    master, there, mux, kind, persistent
):
    name, pid = (
        ('/there/echo', there.process.pid) if kind == 'rospy' else ('/calls/mux/list', mux.pid)
    )
    service = master.lookup_service(name, persistent=persistent)
    service.call()  # a persistent one has a connection by now, another none
    hang(pid)
    try:
        for _ in range(3):
            with pytest.raises(pharos.ServiceCallError, match=f'{name} did not answer in time'):
                service.call(timeout=0.1)
        with nothing_left(service), pytest.raises(pharos.ServiceCallError):
            service.call(timeout=0.1)
    finally:
        os.kill(pid, signal.SIGCONT)
    assert service.call(timeout=TIMEOUT)
    service.close()


@pytest.mark.parametrize('kind', ['rospy', 'roscpp'])
def test_a_provider_that_hangs_holds_up_no_look_up_but_what_needs_its_type(
    master, there, mux, kind, monkeypatch
):
    monkeypatch.setattr('pharos.service.TIMEOUT', 1.0)  # seconds; five else
    name, pid = (
        ('/there/echo', there.process.pid) if kind == 'rospy' else ('/calls/mux/list', mux.pid)
    )
    hang(pid)
    try:
        begin = time.monotonic()
        service = master.lookup_service(name)
        assert time.monotonic() - begin < 0.9
        assert repr(service) == f'<Service {name} of a type not told yet at {service.uri}>'
        with nothing_left(service), pytest.raises(
            pharos.ServiceCallError, match=f'provider of {name} at .*does not answer .*running'
        ):
            service.call()
        with pytest.raises(pharos.ServiceCallError, match=f'{name} at .*does not answer'):
            service.call(timeout=0.1)
        assert connections_to(service) == 0
    finally:
        os.kill(pid, signal.SIGCONT)
    service.call(timeout=TIMEOUT)
    assert service.type == (ECHO if kind == 'rospy' else 'topic_tools/MuxList')


# -- waits


@pytest.mark.parametrize(
    'wait',
    [
        lambda master, name: master.wait_for_service(name, TIMEOUT),
        lambda master, name: master.wait_for_service(name),
        lambda master, name: master.lookup_service(name, wait=TIMEOUT),
        lambda master, name: master.lookup_service(name, wait=None),
    ],
    ids=['wait_for_service', 'without limit', 'lookup_service', 'lookup_service, without limit'],
)
def test_a_service_is_waited_for(master, wait):
    node, looks = create(master, '/awaited'), threading.Event()
    look = pharos.Master.call

    def noted(self, method, *args, **options):
        try:
            return look(self, method, *args, **options)
        finally:
            looks.set()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pharos.Master, 'call', noted)
        awaited = started(lambda: wait(master, '/awaited/late'))
        assert looks.wait(TIMEOUT)  # it was not there
    node.serve('/awaited/late', 'std_srvs/Trigger', lambda request: (True, 'here'))
    assert awaited().call().message == 'here'


def test_a_service_that_is_there_is_not_waited_for(master, there):
    for service in (
        master.wait_for_service('/there/echo', 0),
        master.wait_for_service('/there/echo', timeout=TIMEOUT, caller_id='/me'),
    ):
        assert service.call(load_namespace='ann').message == 'ann'
    assert service.caller_id == '/me'


def test_a_service_that_does_not_come_in_time_is_said(master, there, monkeypatch):
    monkeypatch.setattr('pharos.master_services.PATIENCE', 0.1)
    with pytest.raises(
        pharos.UnknownServiceError,
        match=r"no node offered /there/ecko within 0.1 s \(did you mean '/there/echo'.*: is it start",
    ):
        master.wait_for_service('/there/ecko', 0.1)
    hang(there.process.pid)
    try:
        with pytest.raises(
            pharos.ServiceCallError, match='provider of /there/echo at .*does not answer: is it'
        ):
            master.lookup_service('/there/echo', wait=0.2)
    finally:
        os.kill(there.process.pid, signal.SIGCONT)
    for wait in float('nan'), '1':
        with pytest.raises(ValueError, match='wait is a number of seconds'):
            master.lookup_service('/there/echo', wait=wait)


def test_a_provider_that_was_killed_is_waited_for_until_it_is_there_again(master):
    with provider(master.url, '/mortal') as program:
        kill(program)
        with pytest.raises(pharos.ServiceCallError, match='/mortal/echo .*does not answer'):
            master.wait_for_service('/mortal/echo', 0.2)
        with provider(master.url, '/mortal'):
            service = master.wait_for_service('/mortal/echo', TIMEOUT)
            assert service.call(load_namespace='ann').message == 'ann'


def test_a_stop_ends_a_wait_for_a_service(master):
    raised, waits = queue.Queue(), threading.Event()

    def soul(me):
        try:
            waits.set()
            me.master.wait_for_service('/nobody/offers')
        except BaseException as error:
            raised.put(error)
            raise

    node = create(master, '/waits', soul=soul)
    node.fork()
    assert waits.wait(TIMEOUT)
    node.stop()
    error = raised.get(timeout=TIMEOUT)
    assert isinstance(error, pharos.NodeStoppedError)
    assert str(error) == 'the node that waited for /nobody/offers stops'
    assert not node.errors


def test_ctrl_c_ends_a_wait_for_a_service(master):
    program = 'import pharos\nprint("waits")\npharos.Master().wait_for_service("/nobody/offers")\n'
    with Program(master.url, sys.executable, '-c', program) as waiting:
        waiting.wait_for('waits')
        assert waiting.end(signal.SIGINT) == -signal.SIGINT
        assert 'KeyboardInterrupt' in waiting.read_to_the_end()


def test_a_wait_for_a_service_ends_where_the_master_stays_away_and_goes_on_where_it_comes_back(
    mortal_master, monkeypatch
):
    master = pharos.Master(mortal_master.url)
    awaited = started(lambda: master.wait_for_service('/awaited/late'))
    mortal_master.end()
    mortal_master.come_back()
    node = create(master, '/awaited')
    node.serve('/awaited/late', 'std_srvs/Trigger', lambda request: (True, 'here'))
    assert awaited().call().message == 'here'
    node.stop()
    mortal_master.end()
    monkeypatch.setattr('pharos.master_services.TIMEOUT', 0.2)
    with pytest.raises(pharos.MasterUnreachableError, match=master.url):
        master.wait_for_service('/awaited/late')
    with pytest.raises(pharos.MasterUnreachableError, match=master.url):
        master.wait_for_service('/awaited/late', 0.1)


class Refuser:
    """A provider that tells its type, refuses the call, and does not say why when it is asked."""

    def __init__(self, master):
        self._listening = socket.create_server(('127.0.0.1', 0))
        self._uri = 'rosrpc://127.0.0.1:%d' % self._listening.getsockname()[1]
        self._api = master.api('/refuser')
        self._api.registerService('/refuser/echo', self._uri, 'http://127.0.0.1:1/')
        self.ended = started(self._serve)

    def _serve(self):
        told = {
            'callerid': '/refuser',
            'type': ECHO,
            'md5sum': messages.service_class(ECHO)._md5sum,
        }
        with contextlib.ExitStack() as taken:
            for header in told, {'error': 'not today'}, None:
                connection = taken.enter_context(self._listening.accept()[0])
                if header:
                    rosgraph.network.write_ros_handshake_header(connection, header)
            while connection.recv(4096):  # until the caller has given up
                pass

    def close(self):
        self._api.unregisterService('/refuser/echo', self._uri)
        self._listening.close()


def test_the_time_limit_is_for_the_whole_call_and_includes_asking_why_it_was_refused(
    master, monkeypatch
):
    monkeypatch.setattr('pharos.service.TIMEOUT', 2 * TIMEOUT)
    with contextlib.closing(Refuser(master)) as refuser:
        service, begin = master.lookup_service('/refuser/echo'), time.monotonic()
        with nothing_left(service), pytest.raises(pharos.ServiceCallError, match='/refuser/echo'):
            service.call(timeout=0.5)
        assert time.monotonic() - begin < TIMEOUT
        assert refuser.ended() is None  # it has seen the end of the last connection


# -- providers that end


@persistent_or_not
def test_a_rospy_provider_killed_while_it_is_called(master, persistent):
    with provider(master.url, '/mortal') as program:
        service = master.lookup_service('/mortal/wait', persistent=persistent)
        with nothing_left(service):
            # without any time limit
            calls = [started(lambda: service.call(load_namespace='bob')) for _ in range(3)]
            for _ in calls:
                program.wait_for('called by bob')
            kill(program)
            for error in [ended() for ended in calls]:
                assert type(error) is pharos.ServiceCallError
                assert re.match(
                    'the connection to /mortal/wait .* broke .*is its provider still running',
                    str(error),
                )
        assert service.response is None


def test_a_roscpp_provider_killed_while_it_is_called(master):
    with master.run(
        'topic_tools', 'mux', '/calls/other', '/calls/a', remap={'__ns': '/mortal'}
    ) as process:
        until(lambda: '/mortal/mux/list' in master.services())
        (node,) = master.system_state()[2]['/mortal/mux/list']
        service = master.lookup_service('/mortal/mux/list')
        with nothing_left(service):
            hang(process.pid)  # else it answers before it is killed
            ended = started(service.call)
            until(lambda: connections_to(service))
            os.kill(process.pid, signal.SIGKILL)
            assert type(ended()) is pharos.ServiceCallError
        assert wait_for_end(process.pid, TIMEOUT)
        forget(master.url, node)


def test_a_node_of_this_process_stopped_while_it_is_called(master):
    called, release = threading.Event(), threading.Event()
    node = create(master, '/stops')
    node.serve(
        '/stops/wait',
        'std_srvs/Trigger',
        lambda request: called.set() or {'success': release.wait(TIMEOUT)},
    )
    service = master.lookup_service('/stops/wait')
    ended = started(lambda: service.call(timeout=10 * TIMEOUT))
    assert called.wait(TIMEOUT)
    stopped = started(node.stop)
    assert type(ended()) is pharos.ServiceCallError  # although the block has not returned
    release.set()
    assert stopped() is None
    assert [
        thread.name for thread in threading.enumerate() if thread.name.startswith('/stops')
    ] == []


@pytest.mark.parametrize('moves', [False, True], ids=['at the same address', 'elsewhere'])
def test_a_killed_provider_that_is_there_again_is_called_again_by_eight_threads_at_once(
    master, moves
):
    with provider(master.url, '/phoenix', 'pharos') as program:
        services = [
            master.lookup_service('/phoenix/echo', persistent=persistent)
            for persistent in (True, False)
        ]
        plain = services[1]
        before = plain.uri
        for service in services:
            assert together(
                8, lambda number: service.call(load_namespace=str(number)).message
            ) == list('01234567')
        kill(program)
        with provider(
            master.url, '/phoenix', 'pharos', 0 if moves else int(before.rpartition(':')[2])
        ):
            for service in services:
                look_up_when_all_are_refused(service, 8)
                assert together(
                    8, lambda number: service.call(load_namespace=str(number)).message
                ) == list('01234567')
                assert (service.uri != before) == moves
                service.close()
            assert connections_to(plain) == 0


def look_up_when_all_are_refused(service, count):
    """The worst order: when the second thread looks where the provider is, the first has found it
    already."""
    refused, lock, look_up = threading.Barrier(count), threading.Lock(), service._look_up

    def late(deadline):
        refused.wait(TIMEOUT)
        with lock:
            return look_up(deadline)

    service._look_up = late


# -- many callers, many calls


@pytest.mark.parametrize(
    'where, persistent, timeout, calls',
    [
        ('/here', False, None, 500),
        ('/here', False, TIMEOUT, 100),
        ('/there', True, None, 100),
        ('/there', False, None, 25),
        ('/counted', True, TIMEOUT, 100),
        ('/counted', False, TIMEOUT, 25),
    ],
    ids=[
        'here',
        'here, time limit',
        'rospy, persistent',
        'rospy',
        'pharos, persistent, time limit',
        'pharos, time limit',
    ],
)
def test_each_of_eight_threads_gets_the_answers_to_its_own_requests(
    master, there, counted, threads_alternate, where, persistent, timeout, calls
):
    create(master, '/here').serve('/here/echo', ECHO, echo)
    service = master.lookup_service(where + '/echo', persistent=persistent)

    def answers(number):
        return [
            service.call(load_namespace='%d %d' % (number, turn), timeout=timeout).message
            for turn in range(calls)
        ]

    got = together(8, answers)
    assert got == [['%d %d' % (number, turn) for turn in range(calls)] for number in range(8)]
    assert connections_to(service) <= (8 if persistent else 0)
    service.close()
    assert connections_to(service) == 0


@pytest.mark.parametrize(
    'name, persistent, timeout, calls',
    [
        ('/caller/echo', False, None, 10000),
        ('/caller/echo', False, 60, 10000),
        ('/counted/echo', True, 60, 10000),
        ('/counted/echo', False, 60, 2000),
    ],
    ids=['10,000 here', '10,000 here, time limit', '10,000 persistent', '2,000 plain'],
)
def test_thousands_of_calls_leave_nothing_behind(master, counted, name, persistent, timeout, calls):
    parameters = json.dumps([name, persistent, timeout, calls, counted.process.pid])
    done = subprocess.run(
        [sys.executable, PROGRAMS / 'many_calls.py', parameters],
        env=environment(master.url),
        timeout=120,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    before, after = json.loads(done.stdout)
    grown = {what: after[what] - before[what] for what in after}
    for what in 'descriptors', 'threads', "provider's descriptors":
        assert grown[what] < 50, grown  # one a call would be thousands; a few come and go
    assert grown['allocated'] < 0.1, grown  # MB; the least of objects a call would be 0.5, or 0.1
    assert grown['resident'] < 8 and grown["provider's memory"] < 8, grown


# -- calls within one another

both_limits = pytest.mark.parametrize(
    'timeout', [None, TIMEOUT], ids=['no time limit', 'time limit']
)


@both_limits
@pytest.mark.parametrize('inline', [False, True])
def test_a_delegate_calls_its_own_node_and_one_that_calls_back(master, mailbox, timeout, inline):
    """While it runs, and so holds up the node's other delegates, but no service."""
    first, second = create(master, '/first'), create(master, '/second')
    first.serve('/first/echo', ECHO, echo)
    second.serve(
        '/second/echo',
        ECHO,
        lambda request: call('/first/echo', request.load_namespace + ' called back'),
    )

    def call(name, text):
        return master.lookup_service(name).call(load_namespace=text, timeout=timeout)

    def ask(message, channel):
        mailbox(call('/first/echo', message.data).message, channel)
        mailbox(call('/second/echo', message.data).message, channel)

    first.interested_in('/calls/text', 'std_msgs/String', delegate=ask, inline=inline)
    second.send_to('/calls/text', data='bob')
    first.send_to('/calls/text', data='ann')
    assert sorted(mailbox.take(4)) == ['ann', 'ann called back', 'bob', 'bob called back']
    assert not first.errors
    assert not second.errors


@both_limits
def test_a_delegate_calls_a_provider_elsewhere(master, there, mailbox, timeout):
    node, service = create(master, '/asks'), master.lookup_service('/there/echo', '/asks')
    node.interested_in(
        '/calls/ask',
        'std_msgs/String',
        delegate=lambda message, channel: mailbox(
            service.call(load_namespace=message.data, timeout=timeout).message, channel
        ),
    )
    node.send_to('/calls/ask', data='bob')
    assert mailbox.next() == 'bob'


@both_limits
def test_services_that_call_each_other_in_a_circle_end_with_an_error_at_once(
    master, transcript, timeout
):
    first, second = create(master, '/first'), create(master, '/second')
    first.serve('/first/round', 'std_srvs/Empty', lambda request: to_second.call(timeout=timeout))
    second.serve('/second/round', 'std_srvs/Empty', lambda request: to_first.call(timeout=timeout))
    to_first, to_second = map(master.lookup_service, ['/first/round', '/second/round'])
    with pytest.raises(
        pharos.ServiceCallError, match='/first/round failed: .*call each other in a circle'
    ):
        to_first.call(timeout=timeout)
    assert first.errors
    assert second.errors
    first.serve('/first/echo', ECHO, echo)  # both go on
    assert (
        master.lookup_service('/first/echo').call(load_namespace='bob', timeout=timeout).message
        == 'bob'
    )
    first.stop()
    second.stop()
    assert [
        thread.name
        for thread in threading.enumerate()
        if thread.name.startswith(('/first', '/second'))
    ] == []


@both_limits
def test_a_circle_through_a_delegate_ends_with_an_error_at_once(
    master, transcript, mailbox, timeout
):
    node = create(master, '/turns')
    node.serve('/turns/round', 'std_srvs/Empty', lambda request: service.call(timeout=timeout))
    service = master.lookup_service('/turns/round')

    def turn(message, channel):
        try:
            service.call(timeout=timeout)
        except pharos.ServiceCallError as error:
            mailbox(str(error), channel)

    node.interested_in('/calls/turn', 'std_msgs/Empty', delegate=turn)
    node.send_to('/calls/turn')
    assert 'call each other in a circle' in mailbox.next()


@pytest.mark.usefixtures('master')  # stops what is left, should this fail
def test_a_master_that_is_away_is_told_when_it_is_needed():
    there_was = InProcessMaster()
    master = pharos.Master(there_was.url)
    node = create(master, '/alone')
    node.serve('/alone/echo', ECHO, echo)
    service = master.lookup_service('/alone/echo')
    there_was.stop()
    assert service.call(load_namespace='bob').message == 'bob'  # it is not needed
    node.stop()
    with pytest.raises(pharos.MasterUnreachableError):
        service.call(load_namespace='bob', timeout=TIMEOUT)


# -- a service of ours, called by a C++ program


@pytest.mark.parametrize(
    'topic, status, said', [('front', 0, 'switched from back to front'), ('broken', 1, 'failed')]
)
def test_a_roscpp_client_calls_a_service_of_ours(master, topic, status, said):
    """topic_tools's switch_mux is a C++ program."""
    pharos.define_service(*MUX_TYPES['select'])

    def select(request):
        if request.topic == 'broken':
            raise ValueError('no such input')
        return 'back'

    node = create(master, '/plays_mux')
    node.serve('/calls/ours_select', 'topic_tools/MuxSelect', select)
    with master.run('topic_tools', 'switch_mux', '/calls/ours', topic) as client:
        assert client.wait(TIMEOUT) == status, client.output
        assert said in client.output
    assert [str(error) for error in node.errors] == ['no such input'] * status
