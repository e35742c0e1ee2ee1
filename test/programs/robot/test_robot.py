"""Tests that pass."""
import threading

import pytest
from robot import Echo

from pharos import BlockNode
from pharos.testing import Mailbox, expect_failures, until


@pytest.fixture
def said(create_node):
    return Mailbox(create_node(BlockNode), '/said', 'std_msgs/String')


def test_it_says_again_what_it_hears(create_node, said):
    create_node(Echo, times=2).send_to('/heard', typed_as='std_msgs/String', data='hey')
    assert said.next(timeout=20).data == 'heyhey'


def test_a_mailbox_keeps_what_came(create_node, said):
    echo = create_node(Echo)
    for text in 'abc':
        echo.send_to('/heard', typed_as='std_msgs/String', data=text)
    assert said.wait_for(lambda message: message.data == 'b').data == 'b'
    until(lambda: len(said.all()) == 3)
    assert [message.data for message in said.all()] == ['a', 'b', 'c']
    assert said.next().data == 'c'
    with pytest.raises(TimeoutError, match=r'no message came within 0\.01 s, after 3 others'):
        said.next(timeout=0.01)


def test_nodes_are_named_after_their_classes(create_node):
    assert [create_node(Echo).name for _ in range(3)] == ['/echo', '/echo_2', '/echo_3']
    assert create_node(Echo, '/deep/echo').name == '/deep/echo'


def test_a_failure_may_be_expected(create_node, master):
    expect_failures()
    echo = create_node(Echo)
    echo.send_to('/heard', typed_as='std_msgs/String', data='')
    until(lambda: echo.failures)
    assert master.nodes()


def test_what_ends_in_time_is_not_left(master, create_node):
    create_node(BlockNode)
    threading.Timer(0.05, lambda: None).start()
