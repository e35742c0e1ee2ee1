"""What is changed of a node while it runs: its blocks, its souls, a restart, its class."""
import itertools
import queue
import signal
import sys
import threading
import xmlrpc.client

import pytest

import pharos
from pharos import node_registry
from helpers import create, ended, in_thread, speak_tcpros_only
from pharos.restarts import is_restarting
from pharos.testing import Mailbox, TIMEOUT, until


def publisher(master, topic='/changed', over=None, name='/publisher'):
    """A node that publishes, and its open channel."""
    node = create(master, name)
    if over == 'TCPROS':
        speak_tcpros_only(node)
    return node.output_channel(topic, 'std_msgs/Int32')


def turning(taken, what, seconds=0.001):
    """A soul that puts ``what`` at each of its turns."""

    def soul(me):
        for _ in me.every(seconds):
            taken.put(what)

    return soul


# -- blocks


@pytest.mark.parametrize('inline', [False, True])
@pytest.mark.parametrize('over', ['INTRAPROCESS', 'TCPROS'])
def test_a_delegate_takes_effect_with_the_next_message(master, over, inline):
    node = create(master)
    before, after, own = Mailbox(), Mailbox(), Mailbox()
    channel = node.interested_in('/changed', 'std_msgs/Int32', inline=inline)
    numbers = publisher(master, over=over)
    node.delegate = before
    for number in range(20):  # more than what makes a connection's thread run delegates itself
        numbers.send(data=number)
        assert before.next().data == number
    node.delegate = after
    numbers.send(data=1)
    assert after.next().data == 1
    channel.delegate = own
    numbers.send(data=2)
    assert own.next().data == 2
    channel.delegate = None
    numbers.send(data=3)
    assert after.next().data == 3
    node.delegate = None
    numbers.send(data=4)
    until(lambda: channel.received == 24)
    node.delegate = after
    numbers.send(data=5)
    assert after.next().data == 5
    assert before.empty()
    assert own.empty()
    assert not node.errors


def test_a_soul_takes_effect_with_the_next_run(master):
    node = create(master, soul=lambda me: 'first')
    assert node.execute() == 'first'
    node.soul = lambda me: 'second'
    assert node.execute() == 'second'


# -- souls that begin anew


def test_a_soul_that_turns_goes_on_as_the_new_one_at_its_next_turn_if_asked(master):
    node, taken = create(master), queue.SimpleQueue()
    node.soul = turning(taken, 'left')
    thread = node.fork()
    assert taken.get(timeout=TIMEOUT) == 'left'
    node.soul = turning(taken, 'right')
    assert [taken.get(timeout=TIMEOUT) for _ in range(20)] == ['left'] * 20
    node.renew()
    until(lambda: taken.get(timeout=TIMEOUT) == 'right')
    assert [taken.get(timeout=TIMEOUT) for _ in range(20)] == ['right'] * 20
    node.stop()
    assert ended(thread)
    assert not node.errors


def test_a_soul_that_begins_anew_does_what_it_does_at_its_end_before(master):
    node, taken = create(master), queue.SimpleQueue()

    def drive(me):
        threads = [threading.current_thread()]
        for _ in me.every(0.001):
            for _ in me.every(0.001):  # both loops end
                taken.put('drives')
        taken.put('halts')
        taken.put(threads)

    thread = node.fork(drive)
    for _ in range(2):
        assert taken.get(timeout=TIMEOUT) == 'drives'
        node.renew()
        until(lambda: taken.get(timeout=TIMEOUT) == 'halts')
        assert taken.get(timeout=TIMEOUT) == [thread]


def test_each_soul_that_is_forked_begins_anew_with_its_own_block(master):
    node, taken, other = create(master), queue.SimpleQueue(), queue.SimpleQueue()
    begun = threading.Semaphore(0)

    def block(me):
        begun.release()
        turning(other, 'block')(me)

    node.soul = turning(taken, 'before')
    node.fork()
    node.fork(block, name='another')
    assert begun.acquire(timeout=TIMEOUT)
    node.soul = turning(taken, 'after')
    node.renew()
    assert begun.acquire(timeout=TIMEOUT)
    until(lambda: taken.get(timeout=TIMEOUT) == 'after')


def test_who_executes_a_soul_is_not_asked(master):
    node, taken = create(master), queue.SimpleQueue()
    node.soul = turning(taken, 'executed')
    executing = threading.Thread(target=node.execute, daemon=True)
    executing.start()
    node.fork(turning(queue.SimpleQueue(), 'forked'))
    node.soul = lambda me: taken.put('new')
    assert taken.get(timeout=TIMEOUT) == 'executed'
    node.renew()
    assert [taken.get(timeout=TIMEOUT) for _ in range(20)] == ['executed'] * 20
    node.stop()
    assert ended(executing)


def test_a_soul_that_was_taken_away_ends_when_it_is_to_begin_anew(master):
    node = create(master, soul=turning(queue.SimpleQueue(), 'turns'))
    thread = node.fork()
    node.soul = None
    node.renew()
    assert ended(thread)
    with pytest.raises(pharos.PharosError, match='no soul of /node runs.*fork'):
        node.renew()
    assert not node.errors


def fails(me):
    raise ArithmeticError('no period of 0')


def test_only_souls_that_run_begin_anew_and_that_one_has_failed_is_said(master, transcript):
    node = create(master, soul=fails)
    assert ended(node.fork())
    told = r'soul fails raised ArithmeticError: no period of 0, .*failures.* fork\(\) '
    with pytest.raises(pharos.PharosError, match=f'^no soul of /node runs in .*{told}it again$'):
        node.renew()
    node.soul = lambda me: None
    assert ended(node.fork())
    with pytest.raises(pharos.PharosError, match=r'of its own: fork\(\) it$'):
        node.renew()
    node.stop()
    with pytest.raises(pharos.NodeStoppedError):
        node.renew()


def test_a_soul_that_failed_and_that_its_class_forks_is_back_after_a_restart(master, transcript):
    taken, periods = queue.SimpleQueue(), iter([0, 0.01])

    class Scanner(pharos.Node):
        def start(self):
            super().start()
            self.thread = self.fork(Scanner.scan)

        def scan(self):
            for _ in self.every(next(periods)):
                taken.put('turns')

    node = create(master, '/scanner', Scanner)
    assert ended(node.thread)
    with pytest.raises(pharos.PharosError, match=r'soul .*scan raised ValueError: .*: restart\(\)'):
        node.renew()
    node.restart()
    assert taken.get(timeout=TIMEOUT) == 'turns'
    node.renew()


# -- restart


def soul_of(taken, name):
    """A soul that tells that it has begun, and turns."""

    def soul(me):
        taken.put((name, threading.current_thread().name))
        for _ in me.every(0.001):
            pass

    return soul


def test_a_restart_brings_back_what_the_node_had(master, mailbox):
    node, begun = create(master), queue.SimpleQueue()
    node.soul = soul_of(begun, 'soul')
    node.fork()
    node.fork(soul_of(begun, 'block'), name='another')
    assert ended(node.fork(lambda me: begun.put('ended')))
    first = {begun.get(timeout=TIMEOUT) for _ in range(3)}
    node.soul = soul_of(begun, 'new soul')
    channel = node.interested_in('/changed', 'std_msgs/Int32', delegate=mailbox)
    node.serve('/served', 'std_srvs/Empty', lambda request: {})
    changes = Mailbox()
    node.parameter('~changed').on_change(lambda value: changes(value, None))
    ports, numbers = (node.tcp_port, node.xmlrpc_port), publisher(master)
    node.restart()
    assert node.is_running
    assert ports == (node.tcp_port, node.xmlrpc_port)
    assert first == {'ended', ('soul', '/node soul'), ('block', '/node another')}
    second = {begun.get(timeout=TIMEOUT) for _ in range(2)}
    assert second == {('new soul', '/node soul'), ('block', '/node another')}
    assert channel in node.channels
    numbers.send(data=7)
    assert mailbox.next().data == 7
    master.lookup_service('/served').call()
    master.parameters['/node/changed'] = 5
    assert changes.next() == 5
    assert begun.empty()
    assert not node.errors


class Looping(pharos.Node):
    """Forks in its start(), as listing 3.1 does."""

    def __init__(self, begun):
        super().__init__()
        self.begun = begun

    def start(self):
        super().start()
        self.fork(Looping.loop)

    def loop(self):
        self.begun.put('loop')
        for _ in self.every(0.001):
            pass


def test_what_a_start_forks_is_not_forked_twice_by_a_restart(master):
    begun = queue.SimpleQueue()
    node = create(master, node_class=Looping, begun=begun)
    node.fork(soul_of(begun, 'later'), name='later')
    assert {begun.get(timeout=TIMEOUT) for _ in range(2)} == {'loop', ('later', '/node later')}
    for _ in range(2):
        node.restart()
        assert {begun.get(timeout=TIMEOUT) for _ in range(2)} == {'loop', ('later', '/node later')}
    assert len(node.latest_run.souls.forked) == 2
    assert begun.empty()


@pytest.mark.parametrize('again', ['restart', 'renew'])
def test_what_a_soul_forks_is_not_forked_twice(master, again):
    node, begun = create(master), queue.SimpleQueue()

    def outer(me):
        me.fork(soul_of(begun, 'inner'), name='inner')
        for turn, _ in enumerate(me.every(0.001)):
            if turn == 0:
                begun.put('outer')

    node.fork(outer, name='outer')
    assert {begun.get(timeout=TIMEOUT) for _ in range(2)} == {'outer', ('inner', '/node inner')}
    getattr(node, again)()
    assert {begun.get(timeout=TIMEOUT) for _ in range(2)} == {'outer', ('inner', '/node inner')}
    until(lambda: len(node.latest_run.souls.forked) == 2)
    assert begun.empty()


class Sings(pharos.Node):
    """A soul that tells of its beginnings and its turns."""

    def sing(self):
        for _ in self.every(0.001):
            self.sung = 'Sings'


class Hums(pharos.Node):
    """The same, otherwise."""

    def sing(self):
        for _ in self.every(0.001):
            self.sung = 'Hums'


@pytest.mark.parametrize('how', ['become', 'renew', 'renew sleeper'])
def test_a_soul_begins_anew_by_itself_where_the_one_that_has_forked_it_does_not(master, how):
    node, is_there, release = create(master, node_class=Sings), [], threading.Event()
    node.stop_timeout = 0.1

    def maker(me):
        me.fork(Sings.sing, name='child')
        is_there.append('maker')
        if how == 'renew':
            release.wait(TIMEOUT)  # it never turns
        elif how == 'renew sleeper':
            me.sleep(1000)
        for _ in me.every(0.001):
            pass

    node.fork(maker, name='maker')
    until(lambda: getattr(node, 'sung', None))
    if how == 'become':
        node.become(Hums)
        until(lambda: node.sung == 'Hums')
    else:
        (child,) = [soul for soul in node.latest_run.souls.forked if soul.name == 'child']
        node.renew()
        until(lambda: not child.is_asked)
        node.sung = None
        until(lambda: node.sung)
    assert [soul.name for soul in node.latest_run.souls.forked] == ['maker', 'child']
    assert is_there == ['maker']
    release.set()


def test_a_soul_that_begins_anew_waits_for_what_it_has_forked(master):
    node, alive, most = create(master), [], []
    begun = queue.SimpleQueue()

    def child(me):
        alive.append(me)
        most.append(len(alive))
        for turn, _ in enumerate(me.every(0.05)):
            if turn == 0:
                begun.put('child')
        alive.remove(me)

    def parent(me):
        me.fork(child, name='child')
        for _ in me.every(0.001):
            pass

    def grandparent(me):
        me.fork(parent, name='parent')
        for _ in me.every(0.001):
            pass

    node.fork(grandparent, name='grandparent')
    for _ in range(5):
        assert begun.get(timeout=TIMEOUT) == 'child'
        node.renew()
    assert begun.get(timeout=TIMEOUT) == 'child'
    assert max(most) == 1
    assert begun.empty()
    until(lambda: len(node.latest_run.souls.forked) == 3)


def test_a_restart_of_a_stopped_node_starts_it_with_the_souls_that_the_stop_ended(master):
    node, begun = create(master), queue.SimpleQueue()
    node.fork(soul_of(begun, 'soul'))
    begun.get(timeout=TIMEOUT)
    node.stop()
    node.restart()
    assert node.is_running
    assert begun.get(timeout=TIMEOUT) == ('soul', '/node soul')


def restarts_in(node, where, master):
    """Have a block of the node restart it, once; returns once that has been done."""
    runs, restarted = [node.latest_run], threading.Event()

    def restart(*args):
        if node.latest_run is runs[0]:
            try:
                node.restart()
            finally:
                restarted.set()
        return {}

    if where == 'soul':
        node.fork(restart)
    elif where == 'executed soul':
        node.soul = restart
        assert node.execute() is None
    elif where == 'service':
        node.serve('/restarts', 'std_srvs/Empty', restart)
        master.lookup_service('/restarts').call()
    elif where == 'parameter':
        node.parameter('~restarts').on_change(restart)
        master.parameters[f'{node.name}/restarts'] = 1
    else:
        node.interested_in('/restarts', 'std_msgs/Empty', restart, inline=where == 'inline')
        sender = create(master, '/sender')
        if where == 'TCPROS':
            speak_tcpros_only(sender)
        sender.send_to('/restarts')
    assert restarted.wait(TIMEOUT)
    assert node.latest_run is not runs[0]


BLOCKS = [
    *('soul', 'executed soul', 'delegate', 'inline', 'TCPROS', 'service', 'parameter'),
]


@pytest.mark.parametrize('where', BLOCKS)
def test_a_block_restarts_its_node(master, where, mailbox):
    node, begun = create(master), queue.SimpleQueue()
    node.stop_timeout = 60.0  # which no thread uses up
    node.fork(soul_of(begun, 'other'), name='other')
    node.interested_in('/changed', 'std_msgs/Int32', delegate=mailbox)
    begun.get(timeout=TIMEOUT)
    restarts_in(node, where, master)
    assert begun.get(timeout=TIMEOUT) == ('other', '/node other')
    publisher(master).send(data=3)
    assert mailbox.next().data == 3
    assert node.is_running
    assert not node.errors


def test_a_soul_that_restarts_its_node_begins_again_itself(master):
    node, begun = create(master), queue.SimpleQueue()

    def restart(me):
        begun.put(threading.current_thread())
        if begun.qsize() == 1:
            me.restart()
            begun.put('goes on')
        for _ in me.every(0.001):
            pass

    first = node.fork(restart)
    assert ended(first)
    until(lambda: begun.qsize() == 2)
    assert begun.get() is first
    assert begun.get() is not first
    assert not node.errors


def test_threads_that_restart_a_node_at_once_leave_it_running_with_each_soul_once(master):
    node, begun = create(master), queue.SimpleQueue()
    node.fork(soul_of(begun, 'soul'))
    for _ in range(5):
        go, raised = threading.Barrier(4), []

        def restart():
            go.wait(TIMEOUT)
            try:
                node.restart()
            except BaseException as error:
                raised.append(error)

        threads = [threading.Thread(target=restart, daemon=True) for _ in range(4)]
        for thread in threads:
            thread.start()
        assert all(map(ended, threads))
        assert not raised
        assert node.is_running
        assert len(node.latest_run.souls.forked) == 1
    assert not node.errors


def test_a_node_runs_on_where_the_master_is_away_at_a_restart(mortal_master, mailbox):
    master = pharos.Master(mortal_master.url)
    node, begun = create(master), queue.SimpleQueue()
    node.fork(soul_of(begun, 'soul'))
    node.interested_in('/changed', 'std_msgs/Int32', delegate=mailbox)
    numbers = publisher(master)
    begun.get(timeout=TIMEOUT)
    mortal_master.end()
    with pytest.raises(pharos.MasterUnreachableError):
        node.restart()
    numbers.send(data=1)
    assert mailbox.next().data == 1
    node.stop()
    with pytest.raises(pharos.MasterUnreachableError):
        node.restart()
    mortal_master.come_back()
    node.restart()
    assert begun.get(timeout=TIMEOUT) == ('soul', '/node soul')


def test_a_node_that_is_restarted_keeps_its_name_and_spin_waiting(master):
    class Slow(pharos.Node):
        def start(self):
            if self.latest_run is not None:
                between.append(node_registry.nodes() == [self])
                with pytest.raises(pharos.NodeNameInUseError):
                    create(master, '/slow')
                between.append(spinning.is_alive())
            super().start()

    between = []
    node = create(master, '/slow', Slow)
    spinning = threading.Thread(target=pharos.spin, daemon=True)
    spinning.start()
    node.restart()
    assert between == [True, True]
    node.stop()
    assert ended(spinning)


def test_a_node_that_is_restarted_when_all_are_stopped_stays_stopped(master):
    class Slow(pharos.Node):
        def start(self):
            if self.latest_run is not None:
                node_registry.stop_all()
            super().start()

    node = create(master, '/slow', Slow)
    with pytest.raises(pharos.NodeStoppedError):
        node.restart()
    assert not node.is_running
    assert not node_registry.nodes()


class Halting(pharos.Node):
    """Calls ``meanwhile()`` in its stop or start, before that happens."""

    def __init__(self):
        super().__init__()
        self.halts, self.meanwhile = None, lambda: None

    def start(self):
        if self.latest_run is not None and self.halts == 'start':
            self.meanwhile()
        super().start()

    def stop(self):
        if self.halts == 'stop':
            self.meanwhile()
        super().stop()


@pytest.mark.parametrize('halts, kills', [('stop', False), ('start', False), ('stop', True)])
def test_a_node_that_is_stopped_while_it_is_restarted_stays_stopped(master, halts, kills):
    node = create(master, node_class=Halting)
    node.fork(turning(queue.SimpleQueue(), 'turn'))
    stopping = []

    def stop():
        if kills:
            xmlrpc.client.ServerProxy(node.uri).shutdown('/killer', 'killed')
        else:
            node.stop()

    def meanwhile():
        stopping.append(in_thread(stop))
        until(lambda: not is_restarting(node))

    node.halts, node.meanwhile = halts, meanwhile
    with pytest.raises(pharos.NodeStoppedError, match='/node'):
        node.restart()
    assert ended(*stopping)
    assert not node.is_running
    assert not node_registry.nodes()
    create(master).stop()  # its name is free
    node.halts = None
    node.restart()
    assert node.is_running
    assert not node.errors


def test_a_soul_that_stops_its_node_in_the_end_keeps_it_from_no_restart(master):
    node, begun = create(master), queue.SimpleQueue()

    def soul(me):
        begun.put('begun')
        for _ in me.every(0.001):
            pass
        me.stop()

    node.fork(soul)
    for _ in range(3):
        assert begun.get(timeout=TIMEOUT) == 'begun'
        node.restart()
    assert begun.get(timeout=TIMEOUT) == 'begun'
    assert node.is_running


def test_a_ctrl_c_at_the_prompt_tears_no_restart_up(master, monkeypatch):
    monkeypatch.setattr(sys, 'ps1', '>>> ', raising=False)
    node, begun = create(master, node_class=Halting), queue.SimpleQueue()
    node.halts, node.meanwhile = 'start', lambda: signal.raise_signal(signal.SIGINT)
    node.fork(soul_of(begun, 'soul'))
    assert begun.get(timeout=TIMEOUT)
    with pytest.raises(KeyboardInterrupt):
        node.restart()
    assert node.is_running
    assert begun.get(timeout=TIMEOUT) == ('soul', '/node soul')


def test_a_restart_within_a_start_is_refused(master):
    class Again(pharos.Node):
        tries = 0

        def start(self):
            super().start()
            self.tries += 1
            if self.tries == 2:
                self.restart()

    node = create(master, '/again', Again)
    with pytest.raises(pharos.PharosError, match='/again cannot be restarted by its own start'):
        node.restart()


# -- another class


class First(pharos.Node):
    """Tells what it hears, and by which class."""

    def __init__(self):
        super().__init__()
        self.heard = []

    def hear(self, message, channel):
        self.heard.append((message.data, 'first'))

    def answer(self, request):
        return {'message': 'first'}

    def change(self, value):
        self.heard.append((value, 'first'))

    def turn(self):
        for _ in self.every(0.001):
            self.turned = 'first'

    @classmethod
    def of_class(cls, message, channel):
        channel.node.heard.append((message.data, cls.__name__))

    @staticmethod
    def static(message, channel):
        channel.node.heard.append((message.data, 'first'))


class Second(pharos.Node):
    """The same, otherwise."""

    def __init__(self):
        raise AssertionError('this is not run')

    def hear(self, message, channel):
        self.heard.append((message.data, 'second'))

    def answer(self, request):
        return {'message': 'second'}

    def change(self, value):
        self.heard.append((value, 'second'))

    def turn(self):
        for _ in self.every(0.001):
            self.turned = 'second'

    @classmethod
    def of_class(cls, message, channel):
        channel.node.heard.append((message.data, cls.__name__))

    @staticmethod
    def static(message, channel):
        channel.node.heard.append((message.data, 'second'))


class Lacking(pharos.Node):
    """Lacks the methods of the others."""

    def change(self, value):
        pass


def test_a_node_becomes_one_of_another_class_with_all_of_its_blocks(master):
    node = create(master, node_class=First)
    node.delegate, node.soul = node.hear, First.turn
    node.fork()
    node.fork(First.turn, name='block')
    own = lambda message, channel: node.heard.append((message.data, 'own'))  # noqa: E731
    delegates = [None, node.hear, node.of_class, node.static, First.static, own]
    channels = [node.interested_in('/changed', 'std_msgs/Int32', each) for each in delegates]
    node.serve('/answers', 'std_srvs/Trigger', node.answer)
    node.parameter('~changed').on_change(node.change)
    numbers = publisher(master)
    numbers.send(data=1)
    until(lambda: len(node.heard) == 6)
    uri, connections = node.uri, [channel.connections for channel in channels]
    node.become(Second)
    assert type(node) is Second
    assert (node.uri, node.channels) == (uri, channels)
    assert [channel.connections for channel in channels] == connections
    numbers.send(data=2)
    until(lambda: len(node.heard) == 12)
    by = [name for _, name in node.heard]
    assert sorted(by) == sorted([*['first'] * 4, 'First', 'own', *['second'] * 4, 'Second', 'own'])
    assert [channel.received for channel in channels] == [2] * 6
    assert master.lookup_service('/answers').call().message == 'second'
    master.parameters['/node/changed'] = 5
    until(lambda: node.heard[-1] == (5, 'second'))
    assert node.soul is Second.turn
    until(lambda: [soul.is_asked for soul in node.latest_run.souls.forked] == [False, False])
    node.turned = None
    until(lambda: node.turned)
    assert node.turned == 'second'
    assert not node.errors


@pytest.mark.parametrize('inline', [False, True])
@pytest.mark.parametrize('over', ['INTRAPROCESS', 'TCPROS'])
def test_nothing_is_lost_nor_doubled_while_a_node_changes_its_class(master, over, inline):
    node = create(master, node_class=First)
    channel = node.interested_in(
        '/changed', 'std_msgs/Int32', node.hear, queue_size=100000, inline=inline
    )
    numbers = publisher(master, over=over)
    changed, sent = threading.Event(), []

    def flood():
        while not changed.is_set():
            for _ in range(20):
                numbers.send(data=len(sent))
                sent.append(len(sent))
            until(lambda: len(sent) - channel.received < 1000)  # over TCPROS, it is slower

    thread = threading.Thread(target=flood, daemon=True)
    thread.start()
    for number in range(300):
        node.become((Second, First)[number % 2])
        if number % 3:  # else at once into another
            until(lambda: node.heard and node.heard[-1][1] == type(node).__name__.lower())
    changed.set()
    assert ended(thread)
    until(lambda: len(node.heard) >= len(sent))
    assert [number for number, _ in node.heard] == sent
    assert len([*itertools.groupby(node.heard, key=lambda heard: heard[1])]) >= 100
    assert channel.connections == [('/publisher', over)]
    assert (channel.received, channel.dropped) == (len(sent), 0)
    assert not node.errors


def test_a_node_waits_for_its_delegate_to_become_another(master):
    node, go_on, changed = create(master, node_class=First), threading.Event(), Mailbox()
    classes, begun = [], threading.Event()

    def hear(message, channel):
        begun.set()
        go_on.wait(TIMEOUT)
        classes.append(type(node))

    node.interested_in('/changed', 'std_msgs/Int32', hear)
    publisher(master).send(data=1)
    assert begun.wait(TIMEOUT)
    thread = threading.Thread(target=lambda: changed(node.become(Second), None), daemon=True)
    thread.start()
    assert changed.empty()
    assert type(node) is First
    go_on.set()
    assert ended(thread)
    assert type(node) is Second
    assert classes == [First]


def test_a_node_becomes_another_though_its_stop_left_a_delegate_behind(master):
    node, go_on, begun = create(master, node_class=First), threading.Event(), threading.Event()
    node.stop_timeout = 0.1
    node.interested_in(
        '/changed', 'std_msgs/Int32', lambda *args: begun.set() or go_on.wait(TIMEOUT)
    )
    publisher(master).send(data=1)
    assert begun.wait(TIMEOUT)
    waiting = threading.Thread(target=node.become, args=[Second], daemon=True)
    waiting.start()
    node.stop()
    assert ended(waiting)
    assert type(node) is Second
    node.become(First)
    assert type(node) is First
    go_on.set()


def test_a_soul_that_another_class_has_too_does_not_begin_anew(master):
    class Further(First):
        def hear(self, message, channel):
            pass

    node, begun = create(master, node_class=First), []
    node.delegate = node.hear
    node.fork(First.turn)
    node.fork(lambda me: begun.append(1) or [None for _ in me.every(0.001)])
    until(lambda: begun)
    node.become(Further)
    assert node.delegate.__func__ is Further.hear
    assert not any(soul.is_asked for soul in node.latest_run.souls.forked)


def test_a_delegate_has_its_node_become_another(master):
    class Turns(First):
        def hear(self, message, channel):
            super().hear(message, channel)
            self.become(Second)

    node = create(master, node_class=Turns)
    node.interested_in('/changed', 'std_msgs/Int32', node.hear)
    numbers = publisher(master)
    for number in range(3):
        numbers.send(data=number)
    until(lambda: len(node.heard) == 3)
    assert node.heard == [(0, 'first'), (1, 'second'), (2, 'second')]


class WithSlots(pharos.Node):
    """Instances of another layout."""

    __slots__ = ('further',)


class WrongHear(Second):
    """A delegate that cannot be called as one."""

    def hear(self):
        pass


def test_a_class_that_lacks_a_method_is_refused_before_anything_changes(master):
    node = create(master, node_class=First)
    node.delegate, node.soul = node.hear, First.turn
    node.fork(First.turn, name='turning')
    channel = node.interested_in('/changed', 'std_msgs/Int32', node.static)
    node.serve('/answers', 'std_srvs/Trigger', node.answer)
    node.parameter('~changed').on_change(node.change)
    with pytest.raises(pharos.PharosError) as raised:
        node.become(Lacking)
    assert str(raised.value) == (
        '/node cannot become a Lacking, which has no hear, the delegate of /node; no turn, the soul'
        ' of /node; no static, the delegate of /changed; no answer, the service block of /answers;'
        ' no turn, the soul of the thread turning: define it, or give the node another block first'
    )
    with pytest.raises(TypeError, match=r'called as delegate\(message, channel\).*hear'):
        node.become(WrongHear)
    assert type(node) is First
    assert node.delegate == node.hear
    assert channel.delegate == First.static
    publisher(master).send(data=1)
    until(lambda: node.heard == [(1, 'first')])


class Plain(pharos.Node):
    """Blocks that are methods."""

    def hear(self, message, channel):
        channel.node.heard.append('plain')

    def change(self, value):
        self.heard.append('plain')

    def turn(self):
        self.turned = 'plain'
        for _ in self.every(0.001):
            pass


class Static(pharos.Node):
    """Blocks that are static methods."""

    @staticmethod
    def hear(message, channel):
        channel.node.heard.append('static')

    @staticmethod
    def change(value):
        Static.latest.heard.append('static')

    @staticmethod
    def turn(node):
        node.turned = 'static'
        for _ in node.every(0.001):
            pass


class OfClass(pharos.Node):
    """Blocks that are class methods."""

    @classmethod
    def hear(cls, message, channel):
        channel.node.heard.append('class')

    @classmethod
    def change(cls, value):
        Static.latest.heard.append('class')

    @classmethod
    def turn(cls, node):
        node.turned = 'class'
        for _ in node.every(0.001):
            pass


@pytest.mark.parametrize('first', [Plain, Static, OfClass])
def test_methods_become_static_and_class_methods_and_methods_again(master, first):
    names = {Plain: 'plain', Static: 'static', OfClass: 'class'}
    node = Static.latest = create(master, node_class=first)
    node.heard, node.turned = [], None
    node.interested_in('/changed', 'std_msgs/Int32', node.hear)
    node.parameter('~changed').on_change(node.change)
    node.soul = type(node).turn
    node.fork(type(node).turn)
    numbers = publisher(master)
    for count, kind in enumerate([Static, Plain, OfClass, Static, OfClass, Plain]):
        node.become(kind)
        numbers.send(data=count)
        until(lambda: len(node.heard) == 1)
        master.parameters['/node/changed'] = count
        until(lambda: len(node.heard) == 2)
        assert node.heard == [names[kind]] * 2
        node.heard.clear()
        until(lambda: node.turned == names[kind])
    assert not node.errors


def test_what_is_no_class_that_a_node_can_have_is_refused(master):
    node = create(master)
    for wrong in pharos.Master, node, 'Driver', None:
        with pytest.raises(TypeError, match='/node becomes a node of another subclass of Node'):
            node.become(wrong)
    with pytest.raises(TypeError, match='/node cannot become a WithSlots.*same __slots__'):
        node.become(WithSlots)
    with pytest.raises(TypeError, match='/node is a node, and ScriptNode is the class of a script'):
        node.become(pharos.ScriptNode)
    assert type(node) is pharos.BlockNode
    with pytest.raises(AttributeError):
        node.become(Second)
        node.heard


def test_a_stopped_node_becomes_another_and_starts_as_that(master):
    node = create(master, node_class=First)
    node.interested_in('/changed', 'std_msgs/Int32', node.hear)
    node.fork(First.turn)
    node.stop()
    node.become(Second)
    node.restart()
    publisher(master).send(data=1)
    until(lambda: node.heard == [(1, 'second')])
    until(lambda: getattr(node, 'turned', None) == 'second')
