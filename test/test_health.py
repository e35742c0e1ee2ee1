"""Node.health: how a node is doing, at a glance."""
import threading
import time

import pytest

from helpers import create
from pharos.testing import TIMEOUT, until
from pharos import Master, node_registry, watcher


def test_a_healthy_node(master, mailbox):
    before = time.time()
    node, peer = create(master, '/healthy'), create(master, '/peer')
    node.interested_in('/state', 'std_msgs/String', delegate=mailbox)
    peer.send_to('/state', data='well', typed_as='std_msgs/String')
    mailbox.next()
    health = node.health()
    assert health.registered
    # the watcher may be that of an earlier test
    assert before - 100 < health.reachable_since <= time.time()
    assert health.connections == {'INTRAPROCESS': 1}
    assert (health.dropped, health.errors) == (0, 0)
    # one that answers the master may be about to end
    until(
        lambda: node.health().threads
        == len([t for t in threading.enumerate() if t.name.startswith('/healthy ')])
    )


def test_dropped_messages_and_errors_are_counted(master):
    node, peer = create(master, '/overworked'), create(master, '/peer')
    busy, go_on = threading.Event(), threading.Event()

    def block(message, channel):
        busy.set()
        go_on.wait(TIMEOUT)
        raise ZeroDivisionError

    node.interested_in('/work', 'std_msgs/String', delegate=block, queue_size=1)
    for text in 'abc':
        peer.send_to('/work', data=text, typed_as='std_msgs/String')
        assert busy.wait(TIMEOUT)  # with the first
    go_on.set()
    while node.health().errors < 2:  # identical ones, of which node.errors has one
        threading.Event().wait(0.01)
    assert (node.health().dropped, node.health().errors) == (1, 2)
    assert '1 INTRAPROCESS, 1 dropped, 2 errors' in repr(node)


def test_a_node_that_stopped(master):
    node = create(master, '/over')
    node.output_channel('/said', 'std_msgs/String')
    assert '/over running, 1 channel: ' in repr(node)
    node.stop()
    assert node.health() == (False, None, {}, 0, 0, 0, 0)
    assert str(node.health()) == 'not registered, 0 dropped, 0 errors, 0 threads'
    assert repr(node) == '<BlockNode /over stopped, 0 channels>'


def test_a_master_that_goes_and_comes_back(monkeypatch):
    monkeypatch.setattr(watcher, 'PERIOD', 0.1)
    master = Master.embedded()
    node = create(master, '/orphan')
    since = node.health().reachable_since
    assert since
    master._child.kill()
    master._child.wait()
    while node.health().reachable_since:
        threading.Event().wait(0.01)
    assert node.health().registered is None
    assert 'master away' in repr(node)
    back = Master.embedded(port=int(master.url.rsplit(':', 1)[1].strip('/')))
    while not node.health().registered:
        threading.Event().wait(0.01)
    while not node.health().reachable_since:
        threading.Event().wait(0.01)
    assert node.health().reachable_since > since
    assert 'registered, master reachable since ' in str(node.health())
    node_registry.stop_all()
    back.stop()


@pytest.mark.parametrize(
    'health, line',
    [
        ((None, None, {}, 0, 0, 4), 'master away, 0 dropped, 0 errors, 4 threads'),
        ((None, None, {}, 1, 1, 1), 'master away, 1 dropped, 1 error, 1 thread'),
        ((True, None, {}, 0, 0, 4), 'registered, 0 dropped, 0 errors, 4 threads'),
        (
            (False, None, {'TCPROS': 2, 'INTRAPROCESS': 1}, 3, 4, 5),
            'not registered, 1 INTRAPROCESS, 2 TCPROS, 3 dropped, 4 errors, 5 threads',
        ),
    ],
)
def test_it_is_told_in_a_line(health, line):
    from pharos.health import Health

    assert str(Health(*health)) == line
