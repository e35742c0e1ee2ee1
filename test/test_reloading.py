"""A module that is edited and reloaded while its nodes run, by hand and by IPython's autoreload."""
import importlib
import shutil
import subprocess
import sys

import pytest

from helpers import create
from pharos.testing import Mailbox, TIMEOUT, until
from programs import PROGRAMS, environment

FOLDER = PROGRAMS / 'reloading'


@pytest.fixture
def reloading(monkeypatch, tmp_path):
    """The module ``driver`` of programs/reloading, and what writes it with each 'first' replaced
    by another word."""
    source = FOLDER / 'driver.py'
    path = tmp_path / 'driver.py'
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(sys, 'dont_write_bytecode', True)

    def write(word):
        text = source.read_text().replace('first', word).replace('STEP = 1', f'STEP = {len(word)}')
        path.write_text(text)

    write('first')
    yield importlib.import_module('driver'), write
    del sys.modules['driver']


def test_a_node_becomes_what_a_reload_has_made_of_its_class(master, reloading):
    module, write = reloading
    node = create(master, node_class=module.Driver)
    sums = Mailbox(create(master, '/hearer'), '/sums', 'std_msgs/Int32')
    steps = create(master, '/publisher').output_channel('/steps', 'std_msgs/Int32')
    node.changed = None
    steps.send(data=2)
    assert sums.next().data == 10
    for word in 'second', 'third':
        write(word)
        importlib.reload(module)
        node.become(module.Driver)
        assert master.lookup_service('/step').call().message == word
        master.parameters['/node/step'] = word
        until(lambda: node.changed == word)
        until(lambda: word in node.turned)
    steps.send(data=1)
    assert sums.next().data == 15
    assert {*node.turned[-3:]} == {'third'}
    assert not node.errors


def test_autoreload_changes_a_node_that_runs_by_itself(master, tmp_path):
    """The blocks are methods, one of them calls super()."""
    shutil.copytree(FOLDER, tmp_path / 'edited')
    session = subprocess.run(
        [sys.executable, '-m', 'IPython', '--simple-prompt', '--no-banner', '--colors=NoColor'],
        input=(FOLDER / 'session.ipy').read_text(),
        cwd=tmp_path / 'edited',
        env=environment(master.url, IPYTHONDIR=str(tmp_path / 'ipython')),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=2 * TIMEOUT,
        check=False,
    )
    told = [line.split('told ')[1] for line in session.stdout.splitlines() if 'told ' in line]
    assert told == [
        '2 first first',
        '202 first second',
        '302 third True True',
        'second first',
        'second 0 0',
    ], session.stdout
    assert session.returncode == 0
