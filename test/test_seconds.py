"""Time limits and periods that are none, and those without end."""
import math
import threading

import genpy
import pytest

from pharos.testing import TIMEOUT
import pharos
from pharos import BlockNode
from pharos.seconds import LONGEST, check_seconds

NO_SECONDS = [math.nan, 'x', '1', b'1', [], {}, print]
WAITS = {
    'wait': lambda node, seconds: node.master.wait(seconds),
    'wait_for_node': lambda node, seconds: node.master.wait_for_node('/nobody', seconds),
    'wait_for_subscribers': lambda node, seconds: node.output_channel(
        '/seconds', 'std_msgs/Empty'
    ).wait_for_subscribers(timeout=seconds),
    'call': lambda node, seconds: node.master.lookup_service('/waiting/get_loggers').call(
        timeout=seconds
    ),
    'sleep': lambda node, seconds: node.sleep(seconds),
    'every': lambda node, seconds: node.every(seconds),
    'interested_in': lambda node, seconds: node.interested_in('/seconds_of_nobody', wait=seconds),
    'send_to': lambda node, seconds: node.send_to('/seconds_of_nobody', wait=seconds),
    'connect_timeout': lambda node, seconds: node.send_to(
        '/seconds', typed_as='std_msgs/Empty', connect_timeout=seconds
    ),
}


@pytest.fixture
def node(master):
    return master.create(BlockNode, named='/waiting', domain='127.0.0.1')


@pytest.mark.parametrize('wait', WAITS.values(), ids=WAITS)
@pytest.mark.parametrize('seconds', NO_SECONDS, ids=repr)
def test_what_is_no_number_of_seconds_is_refused(node, wait, seconds):
    with pytest.raises(ValueError, match='is a number of seconds.*, not '):
        wait(node, seconds)


@pytest.mark.parametrize('wait', ['interested_in', 'send_to'])
def test_a_wait_for_a_type_is_not_negative(node, wait):
    with pytest.raises(ValueError, match='wait is a number of seconds, 0 or more, not -1'):
        WAITS[wait](node, -1)


@pytest.mark.parametrize(
    'seconds, expected',
    [
        (math.inf, LONGEST),
        (1e300, LONGEST),
        (10**400, LONGEST),
        (-math.inf, None),
        (-(10**400), -LONGEST),
        (True, 1),
        (0.5, 0.5),
        (genpy.Duration(1, 500000000), 1.5),
    ],
    ids=repr,
)
def test_more_seconds_than_anything_can_wait_are_as_many_as_it_can(seconds, expected):
    if expected is None:
        with pytest.raises(ValueError):
            check_seconds('timeout', seconds)
    else:
        assert check_seconds('timeout', seconds) == expected


@pytest.mark.parametrize('seconds', [math.inf, 1e300, 10**400], ids=repr)
def test_a_wait_without_end_ends_with_what_is_waited_for(master, node, seconds):
    assert master.wait(seconds) is master
    assert master.wait_for_node('/waiting', seconds) is node
    assert master.lookup_service('/waiting/get_loggers').call(timeout=seconds).loggers
    assert next(node.every(seconds)) == 0
    node.interested_in('/seconds_known', 'std_msgs/Empty')
    assert node.output_channel('/seconds_known').wait_for_subscribers(timeout=seconds)
    node.send_to('/seconds_known', connect_timeout=seconds, wait=seconds)


@pytest.mark.parametrize('seconds', [math.inf, 1e300], ids=repr)
def test_a_sleep_without_end_ends_with_the_node(node, seconds):
    asleep = threading.Event()

    def soul(me):
        asleep.set()
        me.sleep(seconds)

    thread = node.fork(soul)
    assert asleep.wait(TIMEOUT)
    node.stop()
    thread.join(TIMEOUT)
    assert not thread.is_alive()
    assert not node.errors


@pytest.mark.parametrize('seconds', [0, -1])
def test_no_time_to_wait_is_enough_for_a_node_that_is_there(master, node, seconds):
    assert master.wait_for_node('/waiting', seconds) is node
    with pytest.raises(pharos.UnknownNodeError, match='/nobody'):
        master.wait_for_node('/nobody', seconds)


def test_a_watch_needs_a_block(master):
    with pytest.raises(TypeError, match='needs a block'):
        master.on_change(None)


@pytest.mark.parametrize('name', [None, 5, ['actionlib']])
def test_a_library_is_given_by_its_name(node, name):
    with pytest.raises(TypeError, match='given by its name'):
        node.ros_import(name)
