"""Closing a channel: nothing runs for it afterwards, and nobody is held up for long by what others
publish inline."""
import threading

import pytest

from helpers import create, ended, in_thread, speak_tcpros_only
from pharos.testing import Mailbox, TIMEOUT, until
from pharos import Master
import pharos
from pharos.messages import define_service
from pharos.openings import Openings
from pharos.private_rospy import local_services
from pharos.private_rospy.connections import Connections

STRING = 'std_msgs/String'


@pytest.mark.parametrize('inline', [False, True])
def test_no_delegate_runs_once_close_has_returned(master, inline):
    runs, proceed, calls = threading.Semaphore(0), threading.Event(), []

    def slow(message, channel):
        runs.release()
        proceed.wait(TIMEOUT)
        calls.append(message.data)

    receiver = create(master, '/receiver')
    closing = receiver.interested_in('/closing', STRING, delegate=slow, inline=inline)
    mailbox = Mailbox()
    receiver.interested_in('/not_closing', STRING, delegate=mailbox)
    sender = create(master, '/sender')
    first = in_thread(lambda: sender.send_to('/closing', typed_as=STRING, data='0'))
    # the delegate is busy, and all the rest waits in the queue
    assert runs.acquire(timeout=TIMEOUT)
    for number in range(1, 10):
        sender.send_to('/closing', data=str(number))

    called_at_return = []

    def close():
        closing.close()
        called_at_return.extend(calls)

    thread = in_thread(close)
    while not closing.closed:
        pass
    proceed.set()
    assert ended(thread)
    assert ended(first)
    sender.send_to('/not_closing', typed_as=STRING, data='done')
    assert mailbox.next().data == 'done'  # whatever was queued before has been looked at
    assert calls == called_at_return == ['0']
    assert closing.received == 1


def test_a_delegate_may_close_its_channel_while_the_channel_opens(master):
    publisher, receiver = create(master, '/publisher'), create(master, '/receiver')
    publisher.output_channel('/latched', STRING, latch=True).send(data='latched')
    closed = threading.Event()

    def close(message, channel):
        channel.close()
        closed.set()

    for inline in (False, True):
        channel = receiver.interested_in('/latched', STRING, delegate=close, inline=inline)
        assert closed.wait(TIMEOUT)
        assert not channel.is_open
        assert receiver.channels == []
        closed.clear()


def test_two_threads_may_close_one_channel(master):
    node = create(master, '/receiver')
    for _ in range(20):
        channels = node.interested_in('/twice', STRING), node.output_channel('/twice', STRING)
        for channel in channels:
            threads = [in_thread(channel.close) for _ in range(4)]
            assert all(map(ended, threads))
        assert node.channels == []


def test_a_channel_may_be_closed_while_its_node_stops(master):
    node = create(master, '/receiver')
    for _ in range(20):
        channels = node.interested_in('/ending', STRING), node.output_channel('/ending', STRING)
        errors, begun = [], threading.Barrier(2)

        def close():
            try:
                begun.wait(TIMEOUT)
                for channel in channels:
                    channel.close()
            except Exception as error:
                errors.append(error)

        thread = in_thread(close)
        begun.wait(TIMEOUT)
        node.stop()
        assert ended(thread)
        assert errors == []
        node.start()
        assert node.channels == []


def test_threads_that_open_channels_side_by_side_lose_none(master):
    node, begun = create(master, '/receiver'), threading.Barrier(8)

    def open_some(number):
        begun.wait(TIMEOUT)
        for index in range(5):
            node.interested_in('/side_by_side', STRING)

    threads = [in_thread(open_some, number) for number in range(8)]
    assert all(map(ended, threads))
    assert len(node.channels) == len(master.topic('/side_by_side').channels) == 40


def test_an_inline_publisher_is_not_held_by_what_others_publish(master):
    """What others bring without end is run by the node's own thread."""
    entered, flooding, over = threading.Event(), threading.Event(), threading.Event()

    def delegate(message, channel):
        if message.data == 'first':
            entered.set()
            flooding.wait(TIMEOUT)
        else:
            over.wait(0.001)  # slower than the others bring messages

    receiver = create(master, '/receiver')
    receiver.interested_in('/busy', STRING, delegate=delegate, inline=True)
    sent, flood = (
        create(master, name).output_channel('/busy', STRING) for name in ('/one', '/many')
    )

    def publish_without_end():
        while not over.is_set():
            flood.send(data='more')
            if flood.sent == 100:
                flooding.set()

    published = in_thread(lambda: sent.send(data='first'))
    assert entered.wait(TIMEOUT)
    other = in_thread(publish_without_end)
    returned = ended(published)  # while the other goes on
    over.set()
    assert returned
    assert ended(other)


def test_inline_nodes_that_send_to_each_other_without_end_let_the_publisher_go(master):
    nodes = [create(master, name) for name in ('/ping', '/pong')]
    channels = [node.output_channel(f'/to{index}', STRING) for index, node in enumerate(nodes)]
    turns = threading.Semaphore(0)

    def pass_on(message, channel):
        turns.release()
        channels[nodes.index(channel.node)].publish(message)

    for index, node in enumerate(nodes):
        node.interested_in(f'/to{1 - index}', STRING, delegate=pass_on, inline=True)
    assert ended(in_thread(lambda: channels[0].send(data='ball')))
    for _ in range(1000):
        assert turns.acquire(timeout=TIMEOUT)  # they go on in the nodes' own threads


def test_a_service_block_that_outlives_its_caller_ends_quietly(master, capfd):
    node = create(master, '/provider')
    entered, proceed = threading.Event(), threading.Event()

    def slow(request):
        entered.set()
        proceed.wait(TIMEOUT)
        return 'x' * (1 << 24)  # more than the socket of a client that has gone takes

    define_service('closing/Large', '---\nstring text\n')
    node.serve('/slow', 'closing/Large', slow)
    service_class = pharos.service_class('closing/Large')
    caller = create(master, '/caller')
    proxy = caller.ros.ServiceProxy('/slow', service_class)
    errors = []

    def call():
        try:
            proxy()
        except Exception as error:
            errors.append(error)

    thread = in_thread(call)
    assert entered.wait(TIMEOUT)
    answering = [thread for thread in threading.enumerate() if thread.name.startswith('/provider ')]
    caller.stop()
    assert ended(thread)
    assert errors
    proceed.set()
    node.stop()
    assert all(map(ended, answering))
    assert 'Traceback' not in capfd.readouterr().err


def test_a_channel_that_is_opened_while_its_node_stops_says_so(master, monkeypatch):
    node = create(master, '/node')
    topics = node.latest_run.rospy.topics
    acquire = topics.acquire_impl

    def acquire_and_stop(*arguments):
        topic = acquire(*arguments)
        node.stop()
        return topic

    monkeypatch.setattr(topics, 'acquire_impl', acquire_and_stop)
    with pytest.raises(
        pharos.NodeStoppedError, match='/node stopped while it opened /closing/late'
    ):
        node.interested_in('/closing/late', 'std_msgs/String')
    assert not node.channels


@pytest.mark.parametrize('is_shared', [False, True])
def test_a_channel_closed_while_it_is_connected_leaves_no_connection(
    master, monkeypatch, is_shared
):
    receiver = create(Master(master.url, share_connections=is_shared), '/receiver')
    if is_shared:
        speak_tcpros_only(receiver)
    channel = receiver.interested_in('/connected', STRING)
    subscription = receiver.latest_run.rospy.subscriber('/connected')
    add_connection = subscription.add_connection

    def add_and_close(connection):
        is_added = add_connection(connection)
        channel.close()
        until(lambda: connection.link.sending.done)
        return is_added

    monkeypatch.setattr(subscription, 'add_connection', add_and_close)
    sent = create(master, '/sender').output_channel('/connected', STRING)
    assert channel.closed
    until(lambda: sent._endpoint.get_num_connections() == 0)


def stopped_while_inline(master, then):
    """Another thread stops a node whose delegate runs inline, and calls ``then(node, thread)``
    meanwhile; returns whether that thread was still stopping it afterwards."""
    entered, stopping, waited = threading.Event(), [], []

    def run(message, channel):
        entered.set()
        until(lambda: stopping and not channel.node.is_running)
        then(channel.node, stopping[0])
        waited.append(stopping[0].is_alive())

    receiver = create(master, '/receiver')
    receiver.interested_in('/inline', STRING, delegate=run, inline=True)
    sender = create(master, '/sender')
    sending = in_thread(lambda: sender.send_to('/inline', typed_as=STRING, data='runs'))
    assert entered.wait(TIMEOUT)
    stopping.append(in_thread(receiver.stop))
    assert ended(stopping[0]) and ended(sending)
    return waited == [True]


def test_the_stop_of_a_node_waits_for_its_delegate_in_the_thread_of_a_publisher(master):
    # well within JOIN_TIMEOUT
    assert stopped_while_inline(master, lambda node, stopping: stopping.join(0.3))


def test_a_delegate_inline_may_stop_its_node_while_another_thread_does(master):
    """Each would wait for the other."""
    assert stopped_while_inline(master, lambda node, stopping: node.stop())


def test_who_closes_a_channel_and_opens_it_again_is_not_taken_for_connected(master, monkeypatch):
    """The publisher's end of the connection is closed somewhat later."""
    receiver, sender = create(master, '/receiver'), create(master, '/sender')
    sent = sender.output_channel('/again', STRING)
    channel = receiver.interested_in('/again', STRING)
    assert sent.wait_for_subscribers(1, TIMEOUT)
    run, closing = sender.latest_run.rospy, []
    start_thread = run.start_thread

    def start_but_close(target, args=(), name=None):
        return closing.append(target) if name == 'closing' else start_thread(target, args, name)

    monkeypatch.setattr(run, 'start_thread', start_but_close)
    channel.close()
    assert not run.connections.sends_to('/receiver', '/again')
    assert sent.connections == []
    for close in closing:
        close()


@pytest.mark.parametrize('of', ['publisher', 'subscriber'])
def test_a_connection_that_is_removed_late_takes_none_with_it_that_has_its_descriptor_by_now(
    master, mailbox, of
):
    """Two threads may close one, as that which sends and that which looks for who has left."""
    receiver, sender = create(master, '/receiver'), create(master, '/sender')
    speak_tcpros_only(receiver)
    sent = sender.output_channel('/again', STRING)
    channel = receiver.interested_in('/again', STRING, delegate=mailbox)
    assert sent.wait_for_subscribers(1, TIMEOUT)
    end = {'publisher': sent, 'subscriber': channel}[of]
    topic = getattr(end.node.latest_run.rospy, of)('/again')
    until(lambda: topic.connections)
    (first,) = topic.connections
    first = getattr(first, '_connection', first)
    first.close()
    until(lambda: topic.connections and sent.connections)
    (second,) = topic.connections
    first._fileno = second.fileno()
    topic.remove_connection(first)
    assert topic.connections == [second]
    sent.send(data='heard')
    assert mailbox.next().data == 'heard'


OPENERS = {
    'input': lambda node: node.interested_in('/restarted', STRING),
    'output': lambda node: node.output_channel('/restarted', STRING),
    'service': lambda node: node.serve('/restarted', 'std_srvs/Empty', lambda request: None),
}


@pytest.mark.parametrize(
    'opens, owner, way',
    [
        (OPENERS['input'], Connections, 'subscribe'),
        (OPENERS['output'], Connections, 'advertise'),
        (OPENERS['service'], local_services, 'offer'),
    ],
    ids=OPENERS,
)
def test_what_is_opened_while_another_thread_restarts_the_node_says_so(
    master, monkeypatch, opens, owner, way
):
    """It would count as open, and be that of the run before."""
    node, errors = create(master, '/node'), Mailbox()
    opened, restarted, really = threading.Event(), threading.Event(), getattr(owner, way)

    def open_slowly(*arguments):
        made = really(*arguments)
        opened.set()
        restarted.wait(TIMEOUT)
        return made

    def open_it():
        try:
            opens(node)
        except pharos.NodeStoppedError as error:
            errors(error, None)

    monkeypatch.setattr(owner, way, open_slowly)
    opening = in_thread(open_it)
    assert opened.wait(TIMEOUT)
    node.restart()
    restarted.set()
    assert ended(opening)
    assert '/node stopped while it opened /restarted' in str(errors.next())
    assert not node.latest_run.opened
    opens(node)
    assert node.latest_run.opened


@pytest.mark.parametrize('ends', ['stop', 'restart'])
@pytest.mark.parametrize('opens', OPENERS.values(), ids=OPENERS)
def test_what_is_opened_just_before_another_thread_ends_the_run_says_so(
    master, monkeypatch, opens, ends
):
    node, really = create(master, '/node'), Openings.remember

    def remember(*arguments):
        monkeypatch.setattr(Openings, 'remember', really)
        assert ended(in_thread(getattr(node, ends)))
        really(*arguments)

    monkeypatch.setattr(Openings, 'remember', remember)
    with pytest.raises(pharos.NodeStoppedError, match='/node stopped while it opened /restarted'):
        opens(node)
    assert not node.latest_run.opened
    if ends == 'stop':
        node.start()
    assert not node.latest_run.opened
    opens(node)
    assert len(node.latest_run.opened) == 1


def test_a_start_that_another_one_follows_opens_nothing_in_that_one(master, monkeypatch):
    node = create(master, '/node')
    channel = node.interested_in('/restarted', STRING)
    node.stop()
    really = type(channel).open

    def start_again():
        node.stop()
        node.start()

    def open_after_another_start(*arguments):
        monkeypatch.setattr(type(channel), 'open', really)
        assert ended(in_thread(start_again))
        really(*arguments)

    monkeypatch.setattr(type(channel), 'open', open_after_another_start)
    with pytest.raises(pharos.NodeStoppedError):
        node.start()
    assert node.channels == [channel]
    assert len(node.latest_run.rospy.subscriber('/restarted').callbacks) == 1


def test_what_another_thread_could_not_open_again_is_opened_when_it_is_needed(
    master, monkeypatch, mailbox
):
    """A thread that sends while the node starts opens the channel itself."""
    node = create(master, '/node')
    node.interested_in('/first', STRING)
    channel = node.output_channel('/restarted', STRING)
    node.stop()
    reopening, goes_on = threading.Event(), threading.Event()
    reopen, advertise = Openings.reopen, Connections.advertise

    def reopen_late(run, opened):
        if opened is not channel:
            reopening.set()
            goes_on.wait(TIMEOUT)
        reopen(run, opened)

    def fail(*arguments):
        monkeypatch.setattr(Connections, 'advertise', advertise)
        raise pharos.MasterUnreachableError('for a moment')

    monkeypatch.setattr(Openings, 'reopen', reopen_late)
    monkeypatch.setattr(Connections, 'advertise', fail)
    starting = in_thread(node.start)
    assert reopening.wait(TIMEOUT)
    with pytest.raises(pharos.MasterUnreachableError):
        node.send_to('/restarted', data='lost')
    goes_on.set()
    assert ended(starting)
    create(master, '/hearer').interested_in('/restarted', STRING, delegate=mailbox)
    node.send_to('/restarted', data='sent')
    assert mailbox.next().data == 'sent'
