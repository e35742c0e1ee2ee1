"""Look at what runs, as a user does: graph, top, topics, nodes, messages, plots, the workspace."""
import contextlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import sysconfig
import tempfile
import xml.etree.ElementTree

import pexpect
import pytest

import helpers
import pharos
from helpers import COMPOSE, DEFAULT_SIGNALS, TIMEOUT, Program, create
from pharos import BlockNode, MasterUnreachableError, UnknownTopicError
from pharos.testing import until

STRING = 'std_msgs/String'
TEXT = 'x' * 1000
RATE = 40  # messages a second, of what sends all the time
REFUSED = 'http://127.0.0.1:1/'  # nobody answers there
ESCAPES = re.compile(r'\x1b\[[0-9;?]*[A-Za-z]|\x1b[()][A-Z0-9]|\x1b[=>78]|\r')


def send_all_the_time(master, topic='/traffic'):
    """Create a node that publishes texts."""
    node = create(master, '/sender')
    channel = node.output_channel(topic, STRING)

    def send(me):
        for _ in me.every(1 / RATE):
            channel.send(data=TEXT)

    node.fork(send)
    return node


def is_about(rate, expected=RATE):
    """True if it is that rate, as far as a busy machine can tell."""
    return expected / 10 < float(rate) < expected * 2.5


@pytest.fixture
def traffic(master):
    """A node /sender that sends to /hearer of the same process."""
    sender = send_all_the_time(master)
    create(master, '/hearer').interested_in('/traffic', STRING, delegate=lambda *_: None)
    assert sender.channels[0].wait_for_subscribers(1, TIMEOUT)
    return sender


@pytest.fixture
def mixed(traffic, peer):
    """The same with /peer, a rospy node of another process, which hears /traffic, too."""
    peer.hear('/traffic', STRING)
    assert traffic.channels[0].wait_for_subscribers(2, TIMEOUT)
    return peer


class Terminal:
    """A program in a terminal, to type into, and what it has written since the last key."""

    def __init__(self, url, *command, size=(40, 160)):
        self._folder = tempfile.TemporaryDirectory()
        environ = {**os.environ, 'TERM': 'xterm', 'PROMPT_TOOLKIT_NO_CPR': '1'}
        environ.update(ROS_MASTER_URI=url, IPYTHONDIR=self._folder.name)
        for name in 'COLUMNS', 'LINES':  # of pytest's own terminal: this one has a size
            environ.pop(name, None)
        first, *more = [*DEFAULT_SIGNALS, *command]
        self._process = pexpect.spawn(
            first, more, env=environ, dimensions=size, encoding='utf-8', timeout=TIMEOUT
        )
        self._written = ''

    @property
    def raw(self):
        """The text that it has written, as it came; reads no more."""
        return self._written

    @property
    def text(self):
        """The text that it has written, without what moves the cursor or colours the text."""
        with contextlib.suppress(pexpect.TIMEOUT, pexpect.EOF):
            self._written += self._process.read_nonblocking(1 << 16, 0.02)
        return ESCAPES.sub('', self._written)

    def wait_for(self, pattern):
        """Wait until it has written that regular expression."""
        try:
            return until(lambda: re.search(pattern, self.text), TIMEOUT)
        except TimeoutError:
            raise AssertionError(f'no {pattern!r} in:\n{self.text}') from None

    def press(self, keys, pattern=''):
        """Type keys, and wait for what comes of them."""
        self._written = ''
        self._process.send(keys)
        return self.wait_for(pattern)

    def enter(self, line, pattern):
        """Type a line, and wait for what comes of it and for the next prompt."""
        self.press(line + '\r', rf'(?s){pattern}.*In \[\d+\]: ')

    def end(self):
        """Wait for its end; returns its exit status."""
        with contextlib.suppress(pexpect.EOF):
            while True:
                self._written += self._process.read_nonblocking(1 << 16, TIMEOUT)
        self._process.wait()
        return self._process.exitstatus

    def __enter__(self):
        return self

    def __exit__(self, *error):
        try:
            self._process.close(force=True)
        except pexpect.ExceptionPexpect:  # it was killed; beside load, its end takes a moment
            self._process.wait()
        self._folder.cleanup()


# -- the graph, from Python


def layout(graph):
    """Lay the picture out by graphviz; the last word of an object's name is the node's."""
    command = ['dot', '-Tdot_json']
    return json.loads(subprocess.check_output(command, input=graph.dot(), text=True))


def frames(graph):
    """Return ``{name of node or topic: the label of the frame around it}``."""
    objects = layout(graph)['objects']
    return {
        objects[index]['name'].split()[-1]: each['label']
        for each in objects
        if each['name'].startswith('cluster')
        for index in each['nodes']
    }


def looks(graph):
    """Return ``{(start, end): styles and colours of its arrows}``."""
    found = layout(graph)
    names = [each['name'].split()[-1] for each in found['objects']]
    drawn = {}
    for edge in found['edges']:
        look = edge.get('style', 'solid'), edge['color']
        drawn.setdefault((names[edge['tail']], names[edge['head']]), set()).add(look)
    return drawn


def test_graph_names_nodes_and_topics(master, mixed):
    graph = master.graph()
    assert isinstance(graph, pharos.Graph)
    assert set(graph.nodes) == {'/sender', '/hearer', '/peer'}
    assert set(graph.topics) == {'/traffic'}


def test_graph_edges_name_transports(master, mixed):
    edges = {(edge.start, edge.end): set(edge.transports) for edge in master.graph().edges}
    assert edges == {
        ('/sender', '/traffic'): {'INTRAPROCESS', 'TCPROS'},
        ('/traffic', '/hearer'): {'INTRAPROCESS'},
        ('/traffic', '/peer'): {'TCPROS'},
    }


def test_graph_frames_are_processes(master, mixed):
    found = frames(master.graph())
    assert str(os.getpid()) in found['/sender']
    assert found['/hearer'] == found['/sender'] == found['/traffic']
    assert str(mixed.pid) in found['/peer']


def test_graph_arrows_differ_by_transport(master, mixed):
    drawn = looks(master.graph())
    (within,), (between,) = drawn['/traffic', '/hearer'], drawn['/traffic', '/peer']
    assert within[0] != between[0]
    assert within[1] != between[1]
    assert drawn['/sender', '/traffic'] == {within, between}


def test_graph_rates_need_seconds(master, traffic):
    assert not master.graph().rates
    graph = master.graph(seconds=0.5)
    assert is_about(graph.rates['/traffic'])
    assert re.search(r'/traffic.* Hz', graph.text())
    assert ' Hz' in graph.dot()


def test_graph_shows_unconnected_topics(master):
    node = create(master, '/alone')
    node.output_channel('/unheard', STRING)
    node.interested_in('/unsent', 'std_msgs/Bool')
    graph = master.graph()
    assert {(edge.start, edge.end, *edge.transports) for edge in graph.edges} == {
        ('/alone', '/unheard'),
        ('/unsent', '/alone'),
    }


def test_empty_graph_is_drawn(master, tmp_path):
    master.graph().save(tmp_path / 'graph.svg')
    assert xml.etree.ElementTree.parse(tmp_path / 'graph.svg').getroot().tag.endswith('svg')


def test_thirty_nodes_in_graph(master, tmp_path):
    names = [f'/many/node_{number}' for number in range(30)]
    for number, name in enumerate(names):
        node = create(master, name)
        node.output_channel(f'/many/topic_{number}', STRING)
        node.interested_in(f'/many/topic_{(number + 1) % 30}', STRING)
    graph = master.graph()
    graph.save(tmp_path / 'graph.svg')
    assert set(graph.nodes) == set(names)
    assert len(graph.edges) == 60
    assert set(names) <= set(re.findall(r'[\w/]+', (tmp_path / 'graph.svg').read_text()))


@pytest.mark.parametrize(
    'suffix, start', [('svg', b'<?xml'), ('png', b'\x89PNG'), ('pdf', b'%PDF'), ('dot', b'digraph')]
)
def test_graph_saves_each_format(master, traffic, tmp_path, suffix, start):
    path = tmp_path / f'graph.{suffix}'
    master.graph().save(str(path))
    assert path.read_bytes().startswith(start)


def test_notebook_shows_graph_as_svg(master, traffic):
    picture = xml.etree.ElementTree.fromstring(master.graph()._repr_svg_())
    assert '/sender' in ''.join(picture.itertext())


def test_dead_node_stays_in_graph(mortal):
    master = mortal.master
    create(master, '/alive').interested_in('/texts', STRING)
    with helpers.Peer(master.url) as peer:
        peer.run(f'rospy.Publisher("/texts", message_class({STRING!r}), queue_size=1)')
        peer.end()
        found = master.graph()
    assert set(found.nodes) == {'/alive', '/peer'}
    assert ('/peer', '/texts') in [(edge.start, edge.end) for edge in found.edges]


def test_roscpp_node_is_no_problem(master):
    """roscpp's getBusStats lacks the code, and a value of each topic that it publishes."""
    sender = send_all_the_time(master)
    with master.run('topic_tools', 'relay', '/traffic', '/relayed', '__name:=relay'):
        create(master, '/hearer').interested_in('/relayed', STRING, delegate=lambda *_: None)
        assert sender.channels[0].wait_for_subscribers(1, TIMEOUT)
        graph = until(lambda: (found := master.graph(0.5)).rates.get('/relayed') and found, TIMEOUT)
    assert graph.nodes['/relay'].problem == ''
    edges = [(edge.start, edge.end, edge.transports) for edge in graph.edges]
    assert ('/traffic', '/relay', ('TCPROS',)) in edges


def program(command, url):
    """Start a program of the package."""
    return helpers.Program(['rosrun', 'pharos', *shlex.split(command)], url)


def test_frozen_node_delays_graph_little(master, mixed):
    os.kill(mixed.pid, signal.SIGSTOP)
    with program('top', master.url) as top:
        graph = master.graph()
        assert top.wait() == 0
    os.kill(mixed.pid, signal.SIGCONT)
    assert set(graph.nodes) == {'/sender', '/hearer', '/peer'}
    assert re.search('^/sender .*[1-9]', top.output, re.MULTILINE)
    assert re.search('^/peer ', top.output, re.MULTILINE)


def test_frozen_master_ends_questions(mortal):
    """Each question ends after its limit of 5 s."""
    pid = mortal.pid
    os.kill(pid, signal.SIGSTOP)
    url = mortal.url
    with program('top', url) as top, program('graph', url) as graph:
        with pytest.raises(MasterUnreachableError):
            mortal.master.graph()
        assert (graph.wait(), top.wait()) == (1, 1)
    os.kill(pid, signal.SIGCONT)
    assert url in graph.output
    assert url in top.output


# -- the programs graph and top: they look at one scene, all at once

COMMANDS = {
    'graph': 'graph',
    'rates': 'graph --rates 0.5',
    'only': "graph --only 'hearer|wrong'",
    'hide': 'graph --hide traffic|peer',
    'graph json': 'graph --json --rates 0.5',
    'top': 'top',
    'once': 'top --once',
    'json': 'top --json',
    'version': 'top --version',
}


class Scene:
    """Output of the programs of nodes of this process, and of /peer in another one."""

    def __init__(self, folder):
        ros_master = helpers.InProcessMaster()
        master = pharos.Master(ros_master.url)
        with contextlib.ExitStack() as stack:
            stack.callback(ros_master.stop)
            peer = stack.enter_context(helpers.Peer(master.url))
            stack.callback(helpers.stop_nodes)
            self._fill(master, peer)
            self.pids = {'own': os.getpid(), 'peer': peer.pid}
            self.svg = folder / 'graph.svg'
            commands = {**COMMANDS, 'picture': f'graph --output {self.svg}'}
            self.codes = {}
            self.output = {}
            for key, command in commands.items():
                running = program(command, master.url)
                self.codes[key] = running.wait()
                self.output[key] = running.output

    def _fill(self, master, peer):
        sender = send_all_the_time(master)
        sender.output_channel('/tf', 'tf2_msgs/TFMessage')
        sender.serve('/lamp', 'std_srvs/SetBool', lambda request: (True, ''))
        hearer = create(master, '/hearer')
        hearer.interested_in('/traffic', STRING, delegate=lambda *_: None)
        hearer.interested_in('/wrong', STRING, delegate=lambda *_: 1 / 0)
        create(master, '/mistaken').send_to('/wrong', data='')
        until(lambda: hearer.failures, TIMEOUT)
        peer.hear('/traffic', STRING)
        assert sender.channels[0].wait_for_subscribers(2, TIMEOUT)


def row_of(name, output):
    """The words of a line of the table of top, by the titles of its columns."""
    titles, *rows = [line.split() for line in output[output.index('NODE ') :].splitlines()]
    return next(dict(zip(titles, row)) for row in rows if row[0] == name)


@pytest.fixture(scope='module')
def scene(tmp_path_factory):
    return Scene(tmp_path_factory.mktemp('scene'))


def test_programs_end_well(scene):
    assert set(scene.codes.values()) == {0}, scene.output


@pytest.mark.parametrize(
    'command, there, left_out',
    [
        ('graph', ['process {own}', 'process {peer}', '/tf'], ['/lamp', ' Hz']),
        ('graph', ['/hearer (INTRAPROCESS)', '/peer (TCPROS)'], ['/rosout']),
        ('rates', ['/sender', '/tf', ' Hz'], ['/rosout']),
        ('only', ['1 nodes, 1 topics', '<- /wrong', '/mistaken (INTRAPROCESS)'], ['/traffic']),
        ('hide', ['3 nodes, 2 topics', '/sender', '/wrong', '/tf'], ['/traffic', '/peer']),
        ('version', [f'pharos {pharos.__version__}\n'], ['NODE']),
    ],
)
def test_program_prints_what_is_asked(scene, command, there, left_out):
    printed = scene.output[command]
    assert [text for text in there if text.format(**scene.pids) not in printed] == []
    assert [text for text in left_out if text in printed] == []


def test_graph_program_saves_picture(scene):
    texts = ''.join(xml.etree.ElementTree.parse(scene.svg).getroot().itertext())
    assert all(name in texts for name in ('/sender', '/hearer', '/peer', '/traffic'))


def test_graph_program_prints_json(scene):
    found = json.loads(scene.output['graph json'])
    assert set(found['nodes']) == {'/sender', '/hearer', '/mistaken', '/peer'}
    assert found['nodes']['/peer']['pid'] == scene.pids['peer']
    assert found['topics']['/traffic'] == STRING
    assert is_about(found['rates']['/traffic'])
    edges = {(edge['start'], edge['end']): edge['transports'] for edge in found['edges']}
    assert edges['/traffic', '/peer'] == ['TCPROS']
    assert edges['/sender', '/tf'] == []


def test_wrong_regular_expression_is_told(scene):
    with program("graph --only '('", REFUSED) as graph:
        assert graph.wait() == 1
    assert re.fullmatch('graph: [^\n]*\n', graph.output)


@pytest.mark.parametrize('command', ['top', 'once'])
def test_top_tells_of_nodes(scene, command):
    output = scene.output[command]
    sender = row_of('/sender', output)
    assert (sender['PID'], sender['CLASS']) == (str(scene.pids['own']), 'BlockNode')
    assert row_of('/peer', output)['PID'] == str(scene.pids['peer'])
    assert row_of('/hearer', output)['FAIL'] == '1'
    assert '\x1b' not in output


def test_top_prints_json(scene):
    rows = {row['NODE']: row for row in json.loads(scene.output['json'])['nodes']}
    assert rows['/sender']['PID'] == scene.pids['own']
    assert is_about(rows['/sender']['OUT/S'])
    assert (rows['/hearer']['FAIL'], rows['/peer']['FAIL']) == (1, None)


def test_top_tells_cpu_of_nodes(master):
    def compute(me):
        for _ in me.every(1e-6):
            sum(range(9999))

    create(master, '/computing', soul=compute).fork()
    create(master, '/idle').interested_in('/topic', STRING)
    with program('top', master.url) as top:
        assert top.wait() == 0
        computing, idle = row_of('/computing', top.output), row_of('/idle', top.output)
    # beside load, the answer to top takes the idle one a good part of a core
    assert float(computing['CPU%']) > float(idle['CPU%'])


def test_top_names_module_that_turned_lock_on(master, monkeypatch):
    """The warning is that of a free-threaded Python; on any other one it is not there."""
    node = create(master, '/locked')
    assert node.health().lock == ''
    text = "The global interpreter lock (GIL) has been enabled to load module 'spam', which has not"
    warnings = {'version': 0, (text, RuntimeWarning, 488): True}
    bootstrap = sys.modules['_frozen_importlib']
    monkeypatch.setattr(bootstrap, '__warningregistry__', warnings, raising=False)
    assert node.health().lock == 'spam has turned the lock on'
    with program('top', master.url) as top:
        assert top.wait() == 0
    assert re.search('^/locked .* spam has turned the lock on', top.output, re.MULTILINE)


@pytest.mark.skipif(
    not sysconfig.get_config_var('Py_GIL_DISABLED'), reason='this Python always has its lock'
)
def test_module_without_a_word_on_the_lock_is_named(master):
    code = (
        'import netifaces, pharos\n'
        'node = pharos.Master().create(pharos.BlockNode, named="/locked")\n'
        'print(node.health().lock)\n'
    )
    environment = {**os.environ, 'ROS_MASTER_URI': master.url}
    environment.pop('PYTHON_GIL', None)
    command = [sys.executable, '-c', code]
    output = subprocess.run(command, env=environment, stdout=subprocess.PIPE, timeout=TIMEOUT)
    assert output.stdout == b'netifaces has turned the lock on\n'


def test_keys_of_top_restart_a_node_and_a_save_reloads_it(master, tmp_path):
    path = tmp_path / 'clock'
    path.write_text('import rospy\nPACE = 1\nrospy.init_node("clock")\nrospy.spin()\n')
    with Program([*COMPOSE, '--reload', '--script', str(path)], master.url) as composed:
        uri = master.wait_for_node('/clock', TIMEOUT).uri
        with Terminal(master.url, 'rosrun', 'pharos', 'top', '--interval', '0.2') as top:
            top.wait_for('/clock')
            top.press('j', '/clock')
            top.press('x', 'stop done: /clock')
            assert not master.call('lookupNode', '/clock')
            top.press('a', 'start done: /clock')
            assert master.node('/clock').uri != uri
        path.write_text(path.read_text().replace('1', '2'))
        until(lambda: '/clock done: __main__.PACE takes effect' in composed.output)
        composed.signal(signal.SIGINT)
        composed.wait()


SIZES = pytest.mark.parametrize('size', [(24, 80), (24, 200)], ids=['80', '200'])


@pytest.fixture
def faulty(traffic):
    """A node whose delegate has failed, beside those of traffic."""
    node = create(traffic.master, '/faulty')
    node.interested_in('/wrong', STRING, delegate=lambda *_: 1 / 0)
    traffic.send_to('/wrong', typed_as=STRING, data='')
    return until(lambda: node.failures and node, TIMEOUT)


@SIZES
def test_keys_of_top_sort_and_filter(master, faulty, size):
    with Terminal(master.url, 'rosrun', 'pharos', 'top', '--interval', '0.2', size=size) as top:
        top.wait_for(r'sorted by NODE[^\n]*\n[^\n]*\nNODE [^\n]*\n/faulty ')
        top.press('s' * 6, r'sorted by OUT/S[^\n]*\n[^\n]*\nNODE [^\n]*\n/sender ')
        top.press('s' * 5, r'sorted by FAIL[^\n]*\n[^\n]*\nNODE [^\n]*\n/faulty ')
        top.press(
            '/hearq\x7f', r'1 of 3 nodes, [^\n]*filter: hear *\n[^\n]*\nNODE [^\n]*\n/hearer '
        )
        top.press('\r', 'filter: hear ')
        top.press('jx', '/hearer is not a node of a composition')
        top.press('/nobody', '0 of 3 nodes, [^\n]*filter: nobody [^~]*nothing there')
        top.press('\x1b', '3 of 3 nodes')
        top.press('q')
        assert top.end() == 0


@SIZES
def test_top_colours_failures(master, faulty, size):
    with Terminal(master.url, 'rosrun', 'pharos', 'top', '--once', size=size) as top:
        assert top.end() == 0
        assert row_of('/faulty', top.text)['FAIL'] == '1'
        assert re.findall(r'\x1b\[1;31m(\d+)', top.raw) == ['1']
        assert max(map(len, top.text.splitlines())) <= size[1]


def test_narrow_top_leaves_columns_out(master, traffic):
    for size, is_wide in [((24, 80), False), ((24, 200), True)]:
        with Terminal(master.url, 'rosrun', 'pharos', 'top', '--once', size=size) as top:
            assert top.end() == 0
            titles = re.search('^NODE.*', top.text, re.MULTILINE)[0].split()
        assert ('CLASS' in titles, 'HOST' in titles) == (is_wide, is_wide)
        assert 'PROBLEM' in titles


def test_top_keeps_to_low_screen(master):
    for number in range(30):
        create(master, f'/many/node_{number:02}')
    with Terminal(master.url, 'rosrun', 'pharos', 'top', '--interval', '9', size=(24, 80)) as top:
        top.wait_for('19 of 30 nodes[^~]*/many/node_18')
        assert '/many/node_19' not in top.text
        top.press('/_29', '1 of 30 nodes[^~]*/many/node_29')


def test_key_q_ends_top(master, traffic):
    with Terminal(master.url, 'rosrun', 'pharos', 'top', '--interval', '0.2') as top:
        top.wait_for('/sender')
        top.press('q')
        assert top.end() == 0


# -- topics and nodes

PEER_SENDS = f'''
publisher = rospy.Publisher('/traffic', message_class('{STRING}'), queue_size=9)
timer = rospy.Timer(rospy.Duration(1 / {RATE}), lambda event: publisher.publish('{TEXT}'))
'''


@pytest.fixture(params=['INTRAPROCESS', 'TCPROS'])
def busy_topic(request, master):
    """The topic /traffic, sent by a node of this process, or of another one."""
    if request.param == 'INTRAPROCESS':
        send_all_the_time(master)
    else:
        request.getfixturevalue('peer').run(PEER_SENDS)
    return master.topic('/traffic')


def test_hz_measures_rate(busy_topic):
    found = busy_topic.hz(0.5)
    assert is_about(found.rate)


def test_bw_measures_bytes(busy_topic):
    found = busy_topic.bw(0.5)
    assert is_about(found.bandwidth, RATE * len(TEXT)), found


def test_last_is_next_message(busy_topic):
    assert busy_topic.last.data == TEXT


def test_watch_shows_messages(master, traffic, transcript):
    master.topic('/traffic').watch(2)
    assert [TEXT[:9] in line for line in transcript] == [True, True]


def test_last_is_latched_message(master):
    create(master).output_channel('/kept', STRING, latch=True).send(data='kept')
    assert master.topic('/kept').last.data == 'kept'


def test_watch_runs_block(master, traffic):
    came = []
    master.topic('/traffic').watch(3, came.append)
    assert [message.data for message in came] == [TEXT] * 3


def test_looks_leave_nothing_behind(master, traffic):
    before = master.system_state()
    master.topic('/traffic').hz(0.1)
    assert master.topic('/traffic').last
    until(lambda: master.system_state() == before, TIMEOUT)


LOOKS = {
    'hz': lambda topic: topic.hz(0.1),
    'bw': lambda topic: topic.bw(0.1),
    'last': lambda topic: topic.last,
    'watch': lambda topic: topic.watch(1),
}


@pytest.mark.parametrize('look', LOOKS.values(), ids=LOOKS)
def test_unpublished_topic_is_told(master, look):
    create(master).interested_in('/unsent', STRING)
    with pytest.raises(UnknownTopicError, match='/unsent'):
        look(master.topic('/unsent'))


def test_node_describes_itself(master, traffic):
    traffic.serve('/lamp', 'std_srvs/SetBool', lambda request: (True, ''))
    told = str(traffic.describe(0.1))
    for text in '/sender', 'BlockNode', f'pid {os.getpid()}', STRING, '/hearer', '/lamp':
        assert text in told


def test_messages_are_shown_in_short(master, transcript):
    for type_, fields, text in [
        ('geometry_msgs/Twist', {'linear': {'x': 2.5}}, 'x: 2.5'),
        ('std_msgs/String', {'data': 'x' * 10**6}, 'x ... 1000008 characters'),
        ('sensor_msgs/Image', {'data': bytes(10**6)}, '0 ... 3000006 characters'),
        ('sensor_msgs/LaserScan', {'ranges': [1.5] * 720}, ' characters\nintensities: []'),
        ('sensor_msgs/JointState', {'name': ['joint'] * 500}, '- joint\n... 510 lines'),
        ('sensor_msgs/PointCloud', {'points': [{'x': 1}] * 300}, '... 1208 lines'),
    ]:
        topic = master.topic(f'/shown/{type_}')
        with create(master) as node:
            node.output_channel(topic.name, type_, latch=True).send(**fields)
            topic.watch(1)
        shown = transcript.pop()
        assert text in shown
        assert len(shown) < 5000


# -- the workspace: one session for all, at a master of its own


@pytest.fixture(scope='module')
def session():
    with Terminal(REFUSED, 'rosrun', 'pharos', 'workspace') as session:
        session.wait_for(r'In \[1\]: ')
        yield session


@pytest.fixture(scope='module')
def session_master(session, tmp_path_factory):
    """The master of the session, for a node of this process."""
    path = tmp_path_factory.mktemp('session') / 'url'
    session.enter(f'print(open({str(path)!r}, "w").write(master.url))', r'\n\d+\n')
    return pharos.Master(path.read_text())


def test_session_has_its_names(session):
    session.enter(
        'print(master.is_reachable(), me.is_running, Node.__name__[::-1])', 'True True edoN'
    )
    session.enter('me', r'Out\[\d+\]: <BlockNode /workspace')


@pytest.mark.parametrize(
    'typed, completed',
    [
        ("me.send_to('/tabb", 'ed_topic'),
        ("me.send_to('/tabbed_topic', lin", 'ear='),
        ("master.node('/tab_", 'node'),
        ("me.parameter('/tab/par", 'ameter'),
        ("message_class('geometry_msgs/QuaternionS", 'tamped'),
        ("service_class('std_srvs/SetB", 'ool'),
        ('master.wait_for_n', 'ode'),
    ],
)
def test_tab_completes_names(session, session_master, typed, completed):
    session_master.parameters['/tab/parameter'] = 1
    with session_master.create(BlockNode, named='/tab_node') as node:
        node.interested_in('/tabbed_topic', 'geometry_msgs/Twist')
        session.press(typed)
        session.wait_for(re.escape(typed[-3:]))
        session.press('\t', completed)
        session.press('\x03\x03')  # the first may end no more than the choice between several words
        session.enter('60 * 7', r'Out\[\d+\]: 420')


def test_tab_is_silent_without_master(mortal):
    with Terminal(mortal.url, 'rosrun', 'pharos', 'workspace') as session:
        session.wait_for(r'In \[1\]: ')
        mortal.end()
        session.press("master.node('/a")
        session.press('\t')
        session.press('\x03\x03')
        session.enter('60 * 7', r'Out\[\d+\]: 420')
        assert 'Traceback' not in session.text


def test_transcript_prints_at_prompt(session, session_master):
    session.enter('show = lambda message, channel: Transcript.show("told", message.data * 2)', '')
    session.enter('told = me.interested_in("/told", "std_msgs/Int32", show)', '')
    session.press('6 * ', r'\*')
    with session_master.create(BlockNode, named='/teller') as teller:
        teller.send_to('/told', data=50)
        session.wait_for('told 100')
    session.enter('70', r'Out\[\d+\]: 420')


def test_failures_are_tabled_and_mended(session):
    session.enter("bad = master.create(BlockNode, named='/bad', soul=lambda me: 1 / 0)", '')
    session.enter('bad.execute()', 'ZeroDivisionError')
    session.enter('print(str(bad.failures).count("ZeroDivisionError"), 6 * 7)', '[1-9] 42')
    session.enter('bad.soul = lambda me: 6 * 111', '')
    session.enter('bad.execute()', r'Out\[\d+\]: 666')


def test_ctrl_c_ends_one_line(session):
    session.press('print("be" "gun"); me.sleep(3600)\r', 'begun')

    def is_interrupted():
        session.press('\x03')
        return 'KeyboardInterrupt' in session.text

    until(is_interrupted, TIMEOUT)
    session.enter('print(me.is_running, 6 * 111)', 'True 666')


def test_session_leaves_no_registration(master):
    with Terminal(master.url, 'rosrun', 'pharos', 'workspace') as session:
        session.wait_for(r'In \[\d+\]: ')
        session.enter('robot = master.create(BlockNode, named="/robot"); me.name', '/workspace')
        session.enter('print(robot.is_running, me.name)', 'True /workspace')
        session.press('exit\r')
        assert session.end() == 0
    assert not any(master.system_state())
