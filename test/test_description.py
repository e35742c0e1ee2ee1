"""Node.describe: a node in words."""
import contextlib
import os
import re
import signal
import sys
import threading

import pytest

from helpers import create, speak_tcpros_only
from pharos import ExternalNode, Master, Node, UnknownNodeError
from pharos.testing import TIMEOUT, until
from programs import PROGRAMS, Program


class Driver(Node):
    def start(self):
        super().start()
        self.commands = self.output_channel('/described', 'std_msgs/String', latch=True)
        self.fork(Driver.drive, name='driving')

    def drive(self):
        for _ in self.every(0.05):
            self.commands.send(data='go')


def test_a_node_is_described_in_words(master, mailbox):
    driver, hearer = create(master, '/driver', Driver), create(master, '/hearer')
    hearer.interested_in('/described', delegate=mailbox)
    mailbox.next()
    text = driver.describe()
    assert re.match(r'/driver: Driver, running: registered, .*1 INTRAPROCESS, 0 dropped', text)
    assert f'pid {os.getpid()} at 127.0.0.1, this process; {driver.uri}, TCPROS' in text
    assert '\n  souls: driving\n' in text
    topic = re.search(
        r'\npublishes\n  /described \[std_msgs/String\], (\S+) Hz, sent \d+, latched,'
        r' to /hearer by INTRAPROCESS\n',
        text,
    )
    assert 20 / 10 < float(topic.group(1)) < 20 * 2
    assert '\noffers\n  /driver/get_loggers [roscpp/GetLoggers]\n' in text
    assert 'hears' not in text
    assert repr(text) == text  # at a prompt
    text = hearer.describe()
    assert re.search(r'\nhears\n  /described .* Hz, received \d+, dropped 0, from /driver by', text)


def test_without_seconds_no_rate_is_told(master):
    driver = create(master, '/driver', Driver)
    create(master, '/hearer').interested_in('/described')
    assert ' Hz' not in driver.describe(seconds=0)


def test_its_parameters_and_failures_are_told(master, mailbox):
    node, peer = create(master, '/fails'), create(master, '/peer')

    def block(message, channel):
        raise ZeroDivisionError(mailbox(message, channel))

    node.interested_in('/failing', 'std_msgs/String', delegate=block)
    node.parameter('~rate', 3)
    node.parameter('~long', 'x' * 100)
    peer.send_to('/failing', typed_as='std_msgs/String', data='x')
    mailbox.next()
    until(lambda: node.failures)
    text = node.describe(0)
    assert f"\nparameters\n  ~long: {'x' * 70}...\n  ~rate: 3\nfailures\n  <Failure of dele" in text
    del master.parameters['/fails']


def test_a_node_that_is_stopped_is_described_too(master):
    node = create(master, '/node')
    node.stop()
    text = node.describe()
    assert text.startswith('/node: BlockNode, stopped: not registered')
    assert 'publishes' not in text


def test_a_node_is_described_while_its_master_is_away(mortal_master):
    master = Master(mortal_master.url)
    driver = create(master, '/driver', Driver)
    mortal_master.end()
    text = driver.describe(0)
    assert '/described [std_msgs/String], sent ' in text
    assert f'no ROS master answers at {master.url}' in text


def test_a_node_of_another_process_is_described_as_far_as_it_tells(master, mailbox):
    hearer = speak_tcpros_only(create(master, '/hearer'))
    with Program(
        master.url,
        *(sys.executable, str(PROGRAMS / 'publishes.py'), '/described', '20', '__name:=apart'),
    ) as program:
        program.wait_for('publishing')
        hearer.interested_in('/described', 'std_msgs/String', delegate=mailbox)
        mailbox.next()
        apart = master.node('/apart')
        text = apart.describe()
        assert text.startswith('/apart: a node of another process, alive\n')
        assert f'pid {program.process.pid} at 127.0.0.1; {apart.uri}\n' in text
        rate = re.search(r'/described \[std_msgs/String\], (\S+) Hz, to /hearer by TCPROS\n', text)
        assert 20 / 10 < float(rate.group(1)) < 20 * 2
        assert '/apart/get_loggers [roscpp/GetLoggers]' in text
        assert re.search(r'\nhears\n  /described .*, from /apart by TCPROS\n', hearer.describe())


def test_a_node_of_pharos_in_another_process_tells_how_it_is_doing(master):
    with Program(master.url, sys.executable, str(PROGRAMS / 'in_trouble.py')) as program:
        program.wait_for('in trouble')
        node = master.node('/in_trouble')
        until(lambda: ', dropped 3, from /peer by' in node.describe(0))
        text = node.describe(0)
    assert text.startswith('/in_trouble: Troubled, a node of another process, alive\n')
    assert re.search(r'\n  3 dropped, 1 failures, 0 souls, \d+ threads\n', text)


def test_the_master_is_asked_once_for_the_names_of_all_who_are_heard(master, monkeypatch):
    hearer = create(master, '/hearer')
    channel = hearer.interested_in('/described', 'std_msgs/String')
    command = sys.executable, str(PROGRAMS / 'publishes.py'), '/described', '20'
    with contextlib.ExitStack() as stack:
        for name in ('/one', '/other'):
            stack.enter_context(Program(master.url, *command, f'__name:={name[1:]}'))
        until(lambda: len(channel.connections) == 2)
        asked, real, here = [], Master.call, threading.get_ident()

        def call(self, method, *args, **more):
            if threading.get_ident() == here:
                asked.append(method)
            return real(self, method, *args, **more)

        monkeypatch.setattr(Master, 'call', call)
        text = hearer.describe(0)
    assert {*re.findall('from (/[a-z]+) by TCPROS', text)} == {'/one', '/other'}
    # for all names; and whether it is registered itself
    assert (asked.count('getSystemState'), asked.count('lookupNode')) == (1, 1)


def test_a_node_that_is_dead_is_described_as_that(mortal_master):
    master = Master(mortal_master.url)
    program = Program(
        master.url,
        *(sys.executable, str(PROGRAMS / 'publishes.py'), '/dead', '20', '__name:=dead'),
    )
    program.wait_for('publishing')
    node = master.wait_for_node('/dead', TIMEOUT)
    program.end(signal.SIGKILL)
    text = node.describe()
    assert text.startswith('/dead: a node of another process, dead: ')
    assert '/dead/get_loggers [of unknown type]' in text


def test_who_has_gone_cannot_be_described(master):
    with pytest.raises(UnknownNodeError, match='no node /gone'):
        ExternalNode(master, '/gone').describe()


@pytest.mark.parametrize('seconds', [-1, 'long', None])
def test_seconds_that_are_none_are_refused(master, seconds):
    with pytest.raises(ValueError, match='seconds is a number of seconds, 0 or more'):
        create(master).describe(seconds)
