"""Blocks: what can be one, and what is refused when it is given because it would never run."""
import functools
from unittest import mock

import pytest

from helpers import create
from pharos.testing import Mailbox
from pharos import Node, Transcript


# -- what would never run


async def coroutine(*args):
    pass


async def async_generator(*args):
    yield


def generator(*args):
    yield


class AsyncCallable:
    async def __call__(self, *args):
        pass


class GeneratorCallable:
    def __call__(self, *args):
        yield


class Methods:
    async def method(self, *args):
        pass


ASYNC = [
    coroutine,
    async_generator,
    AsyncCallable(),
    functools.partial(coroutine),
    mock.AsyncMock(),
    functools.partial(functools.partial(AsyncCallable(), 1), 2),
    Methods().method,
]
GENERATORS = [generator, GeneratorCallable(), functools.partial(generator)]
GIVEN = {
    'a delegate': lambda node, block: setattr(node, 'delegate', block),
    'a delegate of a channel': lambda node, block: node.interested_in(
        '/never', 'std_msgs/Empty', delegate=block
    ),
    'a soul': lambda node, block: setattr(node, 'soul', block),
    'a soul to fork': lambda node, block: node.fork(block),
    'a service block': lambda node, block: node.serve('/never', 'std_srvs/Empty', block),
    'a service block later': lambda node, block: replace_service_block(node, block),
    'a parameter block': lambda node, block: node.parameter('~never').on_change(block),
    'a block for changes': lambda node, block: node.master.on_change(block),
    'on_line': lambda node, block: node.master.run('topic_tools', 'relay', on_line=block),
    'a receiver': lambda node, block: Transcript.on_show(block),
    'a block that fills': lambda node, block: node.send_to(
        '/never', block, typed_as='std_msgs/Empty'
    ),
    'a block that fills in a channel': lambda node, block: node.output_channel(
        '/never', 'std_msgs/Empty'
    ).send(block),
    'a block that fills a request': lambda node, block: fill_request(node, block),
}


def replace_service_block(node, block):
    offered = node.serve('/later', 'std_srvs/Empty', lambda request: None)
    try:
        offered.block = block
    finally:
        offered.close()


def fill_request(node, block):
    offered = node.serve('/asked', 'std_srvs/Empty', lambda request: None)
    try:
        node.master.lookup_service('/asked').call(block)
    finally:
        offered.close()


@pytest.mark.parametrize('give', GIVEN.values(), ids=GIVEN)
def test_a_block_that_is_async_is_refused_when_it_is_given(master, give):
    node = create(master)
    for block in ASYNC:
        with pytest.raises(
            TypeError, match=r'async, would never run.*plain function.*run_coroutine_threadsafe'
        ):
            give(node, block)


@pytest.mark.parametrize('give', GIVEN.values(), ids=GIVEN)
def test_a_generator_function_is_refused_when_it_is_given(master, give):
    node = create(master)
    for block in GENERATORS:
        with pytest.raises(
            TypeError, match=r'a yield, would never run.*plain function.*node.every\(seconds\)'
        ):
            give(node, block)


@pytest.mark.parametrize('method', ['start', 'stop'])
def test_a_node_whose_start_or_stop_is_async_is_refused(master, method):
    async def never(self):
        pass

    with pytest.raises(TypeError, match=f'Async.{method} .*would never run'):
        master.create(type('Async', (Node,), {method: wrong_name(never, method)}), named='/async')
    assert '/async' not in [node.name for node in master.nodes()]


def wrong_name(function, name):
    function.__name__ = name
    return function


def test_a_plain_function_around_an_async_one_is_a_block(master, mailbox):
    @functools.wraps(coroutine)
    def plain(message, channel):
        mailbox(message, channel)

    node = create(master, delegate=plain)
    node.interested_in('/wrapped', 'std_msgs/String')
    node.send_to('/wrapped', data='ran')
    assert mailbox.next().data == 'ran'


# -- what is falsy, and runs all the same


class Falsy(list):
    """A list that can be called, as one that collects what it gets may be; empty, it is false."""

    def __init__(self):
        super().__init__()
        self.mailbox = Mailbox()

    def __call__(self, *args):
        self.mailbox(args[0], None)

    def __hash__(self):
        return id(self)


@pytest.mark.parametrize('inline', [False, True])
def test_a_falsy_delegate_runs(master, inline):
    own, nodes = Falsy(), Falsy()
    node = create(master, delegate=nodes)
    node.interested_in('/falsy', 'std_msgs/String', inline=inline)
    channel = node.interested_in('/falsy', 'std_msgs/String', delegate=own, inline=inline)
    node.send_to('/falsy', data='ran')
    assert own.mailbox.next().data == nodes.mailbox.next().data == 'ran'
    assert nodes.mailbox.empty()
    assert channel.delegate is own


def test_falsy_blocks_of_other_kinds_run(master, transcript):
    soul, serves, parameter, fills, changes, line = (Falsy() for _ in range(6))
    node = create(master, soul=lambda me: pytest.fail('not this one'))
    node.fork(soul)
    assert soul.mailbox.next() is node
    node.soul = soul
    node.execute()
    assert soul.mailbox.next() is node
    node.serve('/falsy_service', 'std_srvs/Empty', serves)
    master.lookup_service('/falsy_service').call(fills)
    assert serves.mailbox.next()._type == fills.mailbox.next()._type == 'std_srvs/EmptyRequest'
    watched = node.parameter('~falsy')
    watched.on_change(parameter)
    watched.set(5)
    assert parameter.mailbox.next() == 5
    end = master.on_change(changes)
    # which says how it is used, and ends
    with master.run('topic_tools', 'relay', on_line=line) as process:
        assert line.mailbox.next() == process.output.split('\n')[0]
    create(master, '/another')
    assert changes.mailbox.next() in ('node', 'topic', 'service')
    end()
    assert not node.errors
    assert not transcript


def test_a_falsy_receiver_of_the_transcript_runs():
    receiver = Falsy()
    before = Transcript.on_show(receiver)
    try:
        Transcript.show('shown')
    finally:
        Transcript.on_show(before)
    assert receiver.mailbox.next() == 'shown'


def test_a_falsy_node_is_known_as_a_node_of_this_process(master):
    class Empty(Node):
        def __len__(self):
            return 0

    node = master.create(Empty, named='/falsy_node', domain='127.0.0.1')
    assert master.node('/falsy_node') is master.wait_for_node('/falsy_node', 20) is node
    node.interested_in('/falsy_topic', 'std_msgs/Empty')
    assert [found for found in master.nodes() if found.name == '/falsy_node'] == [node]
