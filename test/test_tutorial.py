"""doc/tutorial.md: every command in it, typed into a session in a terminal, and what that answers."""
import re
from typing import NamedTuple

import pytest

import pharos
from pharos.testing import Mailbox, until
from programs import ROOT
from sockets import refused_url
from terminal import Terminal

TUTORIAL = ROOT / 'doc' / 'tutorial.md'
IPYTHON = r'^In \[(\d+)\]: *\Z'
#: kind of a block of code -> what is shown where such a line may be typed; what is no Python alone,
#: such as a question mark behind a name, is of the kind ipython
PROMPTS = {'console': '', 'python': IPYTHON, 'ipython': IPYTHON, 'debugger': r'^ipdb> *\Z'}


class Block(NamedTuple):
    """A block of code of the tutorial."""

    line: int
    kind: str
    text: str


def blocks():
    """Those of the tutorial, in their order."""
    source = TUTORIAL.read_text()
    return [
        Block(source.count('\n', 0, found.start()) + 1, found[1], found[2])
        for found in re.finditer(r'^```(\w+)\n(.*?)^```$', source, re.DOTALL | re.MULTILINE)
    ]


def pieces(block):
    """What is entered at once: the lines of a debugger one by one, else the block as it is pasted,
    of which IPython answers the last expression alone."""
    return block.text.splitlines() if block.kind == 'debugger' else [block.text.strip('\n')]


def pattern_of(expected):
    """What matches an answer: its lines, between which others may be, and ``...`` for anything."""
    lines = [line.strip() for line in expected.splitlines() if line.strip() not in ('', '...')]
    return r'(?:.*\n)*?.*'.join(
        r'.*'.join(map(re.escape, line.split('...'))) + r'[^\S\n]*\n' for line in lines
    )


class Reader:
    """Does what the tutorial says."""

    def __init__(self, folder):
        self._folder = folder
        self.terminal = None
        self._shown = 0  # lines, before the last block was typed
        self._status = None

    def do(self, block):
        """Type a block of code, or wait for an answer to the last one."""
        if block.kind == 'text':
            self._expect(block)
            return
        if block.kind == 'console':
            self._open(block.text)
            return
        self.terminal.wait_for(PROMPTS[block.kind])
        self._shown = len(self.terminal.text.splitlines()) - 1
        for piece in pieces(block):
            self.terminal.wait_for(PROMPTS[block.kind])
            self.terminal.paste(piece)
            self.terminal.press(*(['Enter'] if block.kind == 'debugger' else ['Escape', 'Enter']))

    def _open(self, text):
        assert text.startswith('$ ')
        command = text[2:].split()
        self.terminal = Terminal(
            refused_url(), *command, width=200, cwd=self._folder, ROS_PACKAGE_PATH=str(ROOT)
        )

    def _expect(self, block):
        pattern = re.compile(pattern_of(block.text), re.MULTILINE)
        try:
            until(lambda: pattern.search(self._answer()))
        except TimeoutError:
            pytest.fail(f'line {block.line}: not so:\n{block.text}\nbut:\n{self._answer()}', False)

    def _answer(self):
        return '\n'.join(self.terminal.text.splitlines()[self._shown :]) + '\n'


@pytest.fixture
def reader(tmp_path):
    """A reader who has not begun."""
    reader = Reader(tmp_path)
    yield reader
    if reader.terminal:
        reader.terminal.close()


#: the last line of a block -> which way the turtle is to turn after it
TURNS = {
    "driver = master.create(TurtleDriver, named='/my_turtle_driver', domain='127.0.0.1')": 1,
    'driver.become(TurtleDriver)': -1,
    'thread = node.fork()': 1,
    'node.renew()': -1,
}


@pytest.mark.timeout(600)
def test_every_command_of_the_tutorial_does_what_it_says(reader, tmp_path):
    turns, poses = [], Mailbox()
    spectator = None
    for block in blocks():
        sign = TURNS.get(block.text.splitlines()[-1])
        if sign and spectator is None:
            url = reader.terminal.wait_for(r'export ROS_MASTER_URI=(\S+)')[1]
            spectator = pharos.Master(url).create(pharos.BlockNode, named='/spectator')
            spectator.interested_in('/turtle1/pose', delegate=poses)
        reader.do(block)
        if sign:
            poses.wait_for(lambda pose: pose.angular_velocity * sign > 0)
            turns.append(sign)
    assert turns == list(TURNS.values())
    assert (tmp_path / 'graph.svg').read_text().count('<svg') == 1
    spectator.stop()
    assert reader.terminal.wait() == 0
