#!/usr/bin/python3
"""Debugs a failure, while nodes go on: the debugger's commands come from the standard input."""
from pharos import BlockNode, Master, Transcript
from pharos.testing import until

Transcript.on_show(lambda line: None)
heard = []


def on_number(message, channel):
    heard.append(message.data)
    local = message.data
    if message.data == 1:
        raise ValueError(f'{local} is bad')


def counted():
    """Whether the node goes on, which the debugger asks: it hears what it is sent from there."""
    before = len(heard)
    node.send_to('/debugged', data=2)
    return until(lambda: len(heard) > before)


node = Master().create(BlockNode, named='/debugged', domain='127.0.0.1', delegate=on_number)
node.interested_in('/debugged', 'std_msgs/Int32')
node.send_to('/debugged', data=1)
until(lambda: node.failures)
node.failures[-1].debug()
node.delegate = lambda message, channel: heard.append(f'again {message.data}')
print('retried', node.failures[-1].retry(), heard)
node.stop()
