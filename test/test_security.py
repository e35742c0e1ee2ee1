"""The rows of SECURITY.md that no other file shows: who may do what."""
import shutil
import socket
import subprocess
from urllib.parse import urlsplit

import pytest

from helpers import SPIN, Program, create
from pharos import Master
from pharos.testing import until

OTHER_USER = ['setpriv', '--reuid', '65534', '--clear-groups']
needs_other_user = pytest.mark.skipif(
    not shutil.which('setpriv') or subprocess.call([*OTHER_USER, 'true']) != 0,
    reason='needs the right to be another user',
)


def is_reached(url, host='127.0.0.2'):
    """True if somebody listens at the port of a URL also on another address of loopback."""
    with socket.socket() as sock:
        return sock.connect_ex((host, urlsplit(url).port)) == 0


@needs_other_user
def test_composition_obeys_its_own_user_alone(master, bench):
    with master.compose(None, bench.launch_file(program=SPIN)) as composition:
        (node,) = composition.nodes
        until(bench.said)
        for user, status in (OTHER_USER, 1), ([], 0):
            command = [*user, 'rosrun', 'pharos', 'stop', 'program']
            with Program(command, master.url, ROS_HOME='/nowhere') as program:
                assert program.wait() == status, program.output
            assert ('not a node of a composition' in program.output) == bool(status)
            assert node.is_running == bool(status)


def test_node_of_loopback_is_not_reached_elsewhere(master, monkeypatch):
    here = create(master, '/here', domain='127.0.0.1')
    monkeypatch.delenv('ROS_HOSTNAME')
    everywhere = create(master, '/everywhere')
    assert not is_reached(here.uri)
    assert is_reached(everywhere.uri)


def test_embedded_master_is_not_reached_elsewhere(monkeypatch):
    monkeypatch.delenv('ROS_HOSTNAME')
    with Master.embedded() as master:
        assert master.is_reachable()
        assert not is_reached(master.url)
