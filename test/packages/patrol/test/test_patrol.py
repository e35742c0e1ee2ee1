"""The walker and its guard."""
import pharos
from pharos import testing
from patrol.guard import Guard
from patrol.walker import Walker

FAST = ['_period:=0.01']


def test_a_guard_sends_a_walker_up_and_down(create_node: testing.NodeFactory) -> None:
    seen = testing.Mailbox(create_node(pharos.BlockNode), '/position', 'std_msgs/Float64')
    create_node(Guard, argv=['_length:=1.0'])
    create_node(Walker, argv=FAST)
    for end in 1.0, 0.0, 1.0:
        seen.wait_for(lambda message, end=end: message.data == end)


def test_a_walker_stays_where_nobody_sends_it(create_node: testing.NodeFactory) -> None:
    seen = testing.Mailbox(create_node(pharos.BlockNode), '/position', 'std_msgs/Float64')
    create_node(Walker, argv=FAST)
    assert {message.data for message in seen.take(5)} == {0.0}
