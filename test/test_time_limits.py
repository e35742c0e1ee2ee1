"""Time limits: kept whether the master answers, answers slowly, hangs, or is away."""
import contextlib
import http.server
import socket
import threading
import time
import urllib.request

import pytest

from pharos.testing import TIMEOUT
import pharos
from pharos import BlockNode, Master
from pharos.private_rospy.deadlines import time_limit
from pharos.private_rospy.proxies import ServerProxy
from sockets import refused_url

STRING = 'std_msgs/String'
LIMIT = 0.5  # seconds, of all that has a limit
MARGIN = 2.5  # seconds beyond, on a busy machine; what knew no limit took 5 to 15 s


pytestmark = pytest.mark.leaves('at a master that hangs or is away, nothing is unregistered')


class BadMaster:
    """A ROS master behind a proxy that hangs, dribbles its answers, or leaves, when it is told
    to."""

    def __init__(self, url):
        self.mood, self.asked, self.hangs_after = 'good', 0, None
        self.over = threading.Event()
        bad = self

        class Handler(http.server.BaseHTTPRequestHandler):
            protocol_version = 'HTTP/1.1'

            def do_POST(self):
                body = self.rfile.read(int(self.headers['content-length']))
                bad.asked += 1
                if (
                    bad.mood == 'hanging'
                    or bad.hangs_after is not None
                    and bad.asked > bad.hangs_after
                ):
                    bad.over.wait()
                    self.close_connection = True
                    return
                with urllib.request.urlopen(
                    urllib.request.Request(url, body, {'Content-Type': 'text/xml'})
                ) as answer:
                    text = answer.read()
                self.send_response(200)
                self.send_header('Content-Length', str(len(text)))
                self.end_headers()
                self._write(text)

            def _write(self, text):
                if bad.mood == 'dribbling':  # never silent for long, and never through
                    for at in range(len(text)):
                        if bad.over.wait(0.1):
                            return
                        self.wfile.write(text[at : at + 1])
                else:
                    self.wfile.write(text)

            def log_message(self, *_):
                pass

        class Server(http.server.ThreadingHTTPServer):
            daemon_threads, block_on_close = True, False

            def handle_error(self, *_):
                pass  # clients leave: that is what is tested

        self._server = Server(('127.0.0.1', 0), Handler)
        self.url = 'http://127.0.0.1:%d/' % self._server.server_address[1]
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def leave(self):
        self.over.set()
        self._server.shutdown()
        self._server.server_close()


@pytest.fixture
def bad(master):
    """A bad master, at which there is a node."""
    bad = BadMaster(master.url)
    bad.master = Master(bad.url)
    bad.node = bad.master.create(BlockNode, named='/limited', domain='127.0.0.1')
    yield bad
    bad.mood, bad.hangs_after = 'good', None
    pharos.node_registry.stop_all()
    bad.leave()


def timed(function, *errors):
    """Run it; returns the seconds it took, whether it returned or raised one of the errors."""
    begun = time.monotonic()
    try:
        function()
    except errors:
        pass
    return time.monotonic() - begun


USES = {
    'wait': lambda bad: bad.master.wait(LIMIT),
    'wait_for_node': lambda bad: bad.master.wait_for_node('/nobody', LIMIT),
    'wait_for_node of one that is registered': lambda bad: bad.master.wait_for_node(
        '/external', LIMIT
    ),
    'interested_in without a type': lambda bad: bad.node.interested_in(
        '/limits/untyped', wait=LIMIT
    ),
    'output_channel without a type': lambda bad: bad.node.output_channel(
        '/limits/untyped', wait=LIMIT
    ),
    'send_to without a type': lambda bad: bad.node.send_to('/limits/untyped', wait=LIMIT),
    'interested_in': lambda bad: bad.node.interested_in('/limits/in', STRING),
    'output_channel': lambda bad: bad.node.output_channel('/limits/out', STRING),
    'send_to': lambda bad: bad.node.send_to('/limits/out', typed_as=STRING, connect_timeout=LIMIT),
    'send_to a subscriber that has gone': lambda bad: bad.node.send_to(
        '/limits/gone', typed_as=STRING, connect_timeout=LIMIT
    ),
    'a second channel': lambda bad: bad.node.output_channel('/limits/open', STRING),
    'send_to one node': lambda bad: bad.channel.send(to='/nobody'),
    'call': lambda bad: bad.moved.call(timeout=LIMIT),
    'close': lambda bad: bad.channel.close(),
    'serve': lambda bad: bad.node.serve('/limits/served', 'std_srvs/Empty', lambda request: None),
    'close a service': lambda bad: bad.served.close(),
    'create': lambda bad: bad.master.create(BlockNode, named='/limited2', domain='127.0.0.1'),
    'stop': lambda bad: bad.node.stop(),
}


@pytest.fixture
def prepared(bad, master, monkeypatch):
    """What the uses need, made while all was good."""
    monkeypatch.setattr(BlockNode, 'connect_timeout', LIMIT)
    monkeypatch.setattr(BlockNode, 'stop_timeout', LIMIT)
    with socket.socket() as silent:  # a node that is registered, and says nothing
        silent.bind(('127.0.0.1', 0))
        silent.listen()
        uri = 'http://127.0.0.1:%d/' % silent.getsockname()[1]
        api = master.api('/external')
        api.registerSubscriber('/limits/gone', STRING, uri)
        bad.channel = bad.node.output_channel('/limits/open', STRING)
        bad.served = bad.node.serve('/limits/closes', 'std_srvs/Empty', lambda request: None)
        bad.node.parameter('~watched').on_change(lambda value: None)
        provider = master.create(BlockNode, named='/provider', domain='127.0.0.1')
        provider.serve('/limits/moved', 'std_srvs/Empty', lambda request: None)
        bad.moved = bad.master.lookup_service('/limits/moved')
        provider.stop()
        yield bad
        api.unregisterSubscriber('/limits/gone', uri)


@pytest.mark.parametrize('use', USES)
@pytest.mark.parametrize('mood', ['hanging', 'dribbling', 'away'])
def test_no_limit_is_exceeded_at_a_bad_master(prepared, mood, use):
    prepared.mood = mood
    if mood == 'away':
        prepared.leave()
    took = timed(lambda: USES[use](prepared), pharos.PharosError)
    assert took < LIMIT + MARGIN


def test_an_answer_that_dribbles_in_is_cut_off_at_the_limit(bad):
    bad.mood = 'dribbling'
    with pytest.raises(socket.timeout):
        ServerProxy(bad.url, 0.3).getSystemState('/t')


def test_several_calls_share_one_limit(bad):
    proxy = ServerProxy(bad.url, TIMEOUT)
    with time_limit(TIMEOUT):
        proxy.getPid('/t')
        with time_limit(0.0), pytest.raises(socket.timeout):
            proxy.getPid('/t')
        proxy.getPid('/t')


def test_waiting_for_a_node_at_a_hanging_master_says_that_the_master_does_not_answer(bad):
    bad.mood = 'hanging'
    with pytest.raises(pharos.MasterUnreachableError, match=bad.url):
        bad.master.wait_for_node('/nobody', 0.2)
    bad.mood = 'good'
    with pytest.raises(pharos.UnknownNodeError, match='no node /nobody came'):
        bad.master.wait_for_node('/nobody', 0.2)


@pytest.mark.parametrize('answers', range(0, 24, 3))
def test_a_start_at_a_master_that_hangs_midway_is_given_up_in_time(
    bad, master, monkeypatch, answers
):
    monkeypatch.setattr(BlockNode, 'connect_timeout', LIMIT)
    before = set(threading.enumerate())
    bad.hangs_after = bad.asked + answers
    made = []
    took = timed(
        lambda: made.append(bad.master.create(BlockNode, named='/midway', domain='127.0.0.1')),
        pharos.MasterUnreachableError,
    )
    assert took < LIMIT + MARGIN + 2.0  # of unregistering
    bad.hangs_after = None
    for node in made:
        node.stop()
    for thread in set(threading.enumerate()) - before:
        if '/midway' in thread.name:
            thread.join(TIMEOUT)
            assert not thread.is_alive()


@pytest.mark.parametrize('answers', range(4))
def test_a_start_at_a_master_that_leaves_midway_raises_no_error_of_rospys(bad, answers):
    bad.over.set()  # it closes the connection, instead of answering
    bad.hangs_after = bad.asked + answers
    with contextlib.suppress(pharos.MasterUnreachableError):
        bad.master.create(BlockNode, named='/midway', domain='127.0.0.1')


def test_a_start_at_no_master_says_so():
    with pytest.raises(pharos.MasterUnreachableError):
        Master(refused_url()).create(BlockNode, named='/alone', domain='127.0.0.1')
