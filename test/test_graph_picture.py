"""The graph as a picture and as text: what is in it, how it is drawn, and what is left out."""
import dataclasses
import json
import os
import re
import stat
import subprocess
import sys
import threading
import time
import xml.etree.ElementTree

import pytest

from helpers import create, ended
from pharos import Graph, Master, MasterUnreachableError, NodeStoppedError, PharosError, probe
from pharos.live import graphviz, snapshot
from pharos.live.snapshot import (
    ALIVE,
    DEAD,
    Connection,
    Host,
    Process,
    SeenNode,
    SeenService,
    SeenTopic,
    Snapshot,
)
from pharos.testing import TIMEOUT, until
from programs import ROOT, Program, environment, run, script
from sockets import refused_url

STRING = 'std_msgs/String'


def node_of(name, publishes=(), hears=(), offers=(), pid=1, host='robot', state=ALIVE):
    return SeenNode(
        name,
        'http://' + host,
        host,
        pid,
        state,
        '' if state == ALIVE else 'Connection refused',
        False,
        list(publishes),
        list(hears),
        list(offers),
    )


def seen(*nodes, connections=(), types=None):
    """A snapshot of these nodes."""
    topics, services, hosts = {}, {}, {}
    for node in nodes:
        for name in [*node.publishes, *node.hears]:
            topics.setdefault(name, SeenTopic(name, (types or {}).get(name, STRING), [], []))
        for name in node.publishes:
            topics[name].publishers.append(node.name)
        for name in node.hears:
            topics[name].subscribers.append(node.name)
        for name in node.offers:
            services[name] = SeenService(name, [node.name])
        processes = hosts.setdefault(node.host, {})
        processes.setdefault(node.pid or node.name, []).append(node.name)
    return Snapshot(
        'http://robot:11311/',
        time.time(),
        [
            Host(host, False, [Process(nodes_by[names[0]].pid, names) for names in found.values()])
            for nodes_by in [{node.name: node for node in nodes}]
            for host, found in hosts.items()
        ],
        {node.name: node for node in nodes},
        topics,
        services,
        [Connection(*each) for each in connections],
    )


def frames(graph):
    """``{path of labels of frames: what is in the innermost of them}``, read from the text for
    graphviz, which lays it out as JSON."""
    laid_out = json.loads(graphviz_json(graph.dot()))
    objects = {each['_gvid']: each for each in laid_out['objects']}
    clusters = [each for each in laid_out['objects'] if each['name'].startswith('cluster')]
    paths = {}
    for each in objects.values():
        if not each['name'].startswith('cluster'):
            around = [c for c in clusters if each['_gvid'] in c.get('nodes', ())]
            around.sort(key=lambda cluster: -len(cluster['nodes']))
            paths[each['name']] = [cluster['label'] for cluster in around]
    return paths


def graphviz_json(dot):
    return subprocess.run(
        ['dot', '-Tdot_json'], input=dot, stdout=subprocess.PIPE, text=True, check=True
    ).stdout


def arrows(graph):
    """``{(start, end): the styles of its arrows}``"""
    laid_out = json.loads(graphviz_json(graph.dot()))
    names = {each['_gvid']: each['name'] for each in laid_out['objects']}
    found = {}
    for edge in laid_out.get('edges', ()):
        look = edge.get('style', 'solid'), edge['color'], float(edge['penwidth'])
        found.setdefault((names[edge['tail']], names[edge['head']]), []).append(look)
    return found


# -- what a real graph looks like


@pytest.fixture
def small(master):
    """Two nodes of this process and one of another, connected."""
    one, two = create(master, '/picture_one'), create(master, '/picture_two')
    sent = one.output_channel('/picture_a', STRING)
    two.interested_in('/picture_a', STRING)
    with master.run('topic_tools', 'relay', '/picture_a', '/picture_b', name='picture_cpp') as cpp:
        assert sent.wait_for_subscribers(2, TIMEOUT)
        yield cpp


def test_nodes_of_a_process_are_in_one_frame_and_a_topic_where_its_publishers_are(master, small):
    create(master, '/picture_three').interested_in('/picture_own', STRING)
    graph = master.graph()
    assert isinstance(graph, Graph)
    own, other = f'process {os.getpid()}', f'process {small.pid}'
    assert frames(graph) == {
        'node /picture_one': [own],
        'node /picture_two': [own],
        'node /picture_three': [own],
        'node /picture_cpp': [other],
        'topic /picture_own': [own],
        'topic /picture_a': [own],
    }


def test_intraprocess_and_tcpros_differ_in_more_than_colour(master, small):
    drawn = arrows(master.graph())
    (within,) = drawn['topic /picture_a', 'node /picture_two']
    (between,) = drawn['topic /picture_a', 'node /picture_cpp']
    assert all(one != other for one, other in zip(within, between))
    assert sorted(drawn['node /picture_one', 'topic /picture_a']) == sorted([within, between])


def test_every_transport_and_the_lack_of_one_is_drawn_in_its_own_way_and_in_the_legend():
    transports = 'INTRAPROCESS', 'TCPROS', 'UDPROS'
    hearers = [node_of('/' + each.lower(), [], ['/t']) for each in (*transports, 'nobody')]
    connections = [('/t', '/a', '/' + each.lower(), each) for each in transports]
    graph = Graph(seen(node_of('/a', ['/t']), *hearers, connections=connections))
    drawn = [arrows(graph)['topic /t', 'node ' + node.name] for node in hearers]
    assert len({color for ((_, color, _),) in drawn}) == 4
    assert len({(style, width) for ((style, _, width),) in drawn}) == 4
    legend = graph.dot().partition('label=<')[2].partition('</table>')[0]
    assert all(each in legend for each in (*transports, 'nothing connected'))
    assert 'UDPROS' not in Graph(seen(node_of('/a', ['/t']))).dot()


def test_edges_say_who_sends_what_and_how(master, small):
    edges = {(edge.kind, edge.start, edge.end): edge.transports for edge in master.graph().edges}
    assert edges == {
        ('publishes', '/picture_one', '/picture_a'): ('INTRAPROCESS', 'TCPROS'),
        ('hears', '/picture_a', '/picture_two'): ('INTRAPROCESS',),
        ('hears', '/picture_a', '/picture_cpp'): ('TCPROS',),
    }
    (to_cpp, to_two) = master.graph(nodes_only=True).edges
    assert (to_cpp.end, to_cpp.transports) == ('/picture_cpp', ('TCPROS',))
    assert (to_two.end, to_two.transports) == ('/picture_two', ('INTRAPROCESS',))
    assert to_two.topics == ('/picture_a',)


def test_the_text_names_hosts_processes_nodes_and_transports(master, small):
    text = master.graph().text()
    assert f'process {os.getpid()}\n    /picture_one\n' in text
    line = '-> /picture_a  std_msgs/String  to /picture_cpp (TCPROS), /picture_two (INTRAPROCESS)'
    assert line in text
    assert '<- /picture_a  from /picture_one (INTRAPROCESS)' in text
    assert '-> /picture_two (INTRAPROCESS)  /picture_a' in master.graph(nodes_only=True).text()


def test_rates_are_counted_where_they_are_asked_for(master, small):
    (one,) = [node for node in master.local_nodes() if node.name == '/picture_one']

    def send(me):
        for _ in me.every(0.01):
            me.send_to('/picture_a', data='tick')

    one.fork(send)
    graph = master.graph(seconds=0.5)
    assert 100 / 10 < graph.rates['/picture_a'] < 100 * 2
    assert ' Hz' in graph.dot() and ' Hz' in graph.text()
    assert master.graph().rates == {}


# while it asks other nodes, or waits
@pytest.mark.parametrize('is_asking', [True, False])
def test_counting_ends_with_the_node_whose_soul_counts(master, monkeypatch, is_asking):
    node = create(master, '/picture_one')
    ends, began = [], threading.Event()
    take, pause = snapshot.take, probe.Look.pause

    def take_when_it_stops(*args, **options):
        seen = take(*args, **options)
        if is_asking:
            began.set()
            assert node.latest_run.rospy.ended.wait(TIMEOUT)
        return seen

    def pause_when_it_began(look, seconds):
        began.set()
        pause(look, seconds)

    monkeypatch.setattr(snapshot, 'take', take_when_it_stops)
    monkeypatch.setattr(probe.Look, 'pause', pause_when_it_began)

    def count(me):
        try:
            me.master.graph(seconds=1000)
        except NodeStoppedError as error:
            ends.append(error)
            raise

    thread = node.fork(count)
    assert began.wait(TIMEOUT)
    node.stop()
    assert ended(thread) and ends


def test_a_dead_node_is_shown_as_such_and_can_be_hidden(master):
    create(master, '/picture_one').interested_in('/picture_dead_a', STRING)
    uri = refused_url()
    master.api('/picture_dead').registerPublisher('/picture_dead_a', STRING, uri)
    try:
        graph, without = master.graph(), master.graph(hide='unreachable')
    finally:
        master.api('/picture_dead').unregisterPublisher('/picture_dead_a', uri)
    assert graph.nodes['/picture_dead'].state == DEAD
    assert '>dead<' in graph.dot() and '[dead: ' in graph.text()
    assert '/picture_dead' not in without.nodes and '/picture_one' in without.nodes


# -- what is drawn, and what is left out


def test_hosts_are_frames_where_there_are_several():
    graph = Graph(
        seen(
            node_of('/a', ['/t', '/v'], host='robot', pid=1),
            node_of('/b', ['/u', '/v', '/w'], ['/t'], host='robot', pid=2),
            node_of('/c', ['/w'], ['/u'], host='laptop', pid=1),
        )
    )
    assert frames(graph) == {
        'node /a': ['host robot', 'process 1'],
        'node /b': ['host robot', 'process 2'],
        'node /c': ['host laptop', 'process 1'],
        'topic /t': ['host robot', 'process 1'],
        'topic /u': ['host robot', 'process 2'],
        'topic /v': ['host robot'],
        'topic /w': [],
    }


def test_a_node_and_a_topic_of_one_name_are_two():
    graph = Graph(seen(node_of('/same', ['/same'])))
    assert set(arrows(graph)) == {('node /same', 'topic /same')}


def test_frames_may_be_namespaces_one_in_another_or_none():
    look = seen(node_of('/r/arm/driver', ['/r/t']), node_of('/r/base', [], ['/r/t']))
    assert frames(Graph(look, group='namespace')) == {
        'node /r/arm/driver': ['/r', '/r/arm'],
        'node /r/base': ['/r'],
        'topic /r/t': ['/r'],
    }
    assert set(map(tuple, frames(Graph(look, group='none')).values())) == {()}


def test_what_every_node_has_is_left_out_unless_all_is_asked_for():
    quiet = ['/rosout', '/rosout_agg', '/statistics', '/clock', '/a/parameter_updates']
    look = seen(
        node_of('/a', [*quiet, '/t'], ['/clock'], ['/a/get_loggers', '/a/reset']),
        node_of('/rosout', ['/rosout_agg'], ['/rosout']),
    )
    graph, whole = Graph(look, services=True), Graph(look, services=True, show_all=True)
    assert (list(graph.nodes), list(graph.topics)) == (['/a'], ['/t'])
    assert list(graph.services) == ['/a/reset']
    assert list(whole.nodes) == ['/a', '/rosout'] and set(whole.topics) == {*quiet, '/t'}
    assert list(whole.services) == ['/a/get_loggers', '/a/reset']
    assert not Graph(look).services


def test_topics_can_be_hidden_by_what_they_are():
    look = seen(
        node_of('/a', ['/heard', '/unheard', '/idle', '/tf', '/image'], ['/alone']),
        node_of('/b', ['/unheard'], ['/heard', '/idle', '/tf', '/image']),
        connections=[(topic, '/a', '/b', 'TCPROS') for topic in ('/heard', '/tf', '/image')],
        types={'/image': 'sensor_msgs/Image', '/tf': 'tf2_msgs/TFMessage'},
    )
    every = {'/heard', '/unheard', '/idle', '/tf', '/image', '/alone'}
    assert set(Graph(look).topics) == every
    assert every - set(Graph(look, hide='leaf').topics) == {'/alone'}
    assert every - set(Graph(look, hide='unheard').topics) == {'/unheard'}
    assert every - set(Graph(look, hide='idle').topics) == {'/unheard', '/idle', '/alone'}
    assert every - set(Graph(look, hide=['tf', 'images']).topics) == {'/tf', '/image'}


def test_a_namespace_has_its_nodes_and_what_these_use():
    look = seen(
        node_of('/r/a', ['/t']), node_of('/robot/b', ['/u'], ['/t']), node_of('/r', [], ['/v'])
    )
    graph = Graph(look, namespace='/r')
    assert (set(graph.nodes), set(graph.topics)) == ({'/r', '/r/a'}, {'/t', '/v'})
    assert {edge.start for edge in graph.edges} == {'/r/a', '/v'}
    assert set(Graph(look, namespace=['r', '/robot']).nodes) == {'/r', '/r/a', '/robot/b'}


def test_what_a_node_sends_to_itself_does_not_hide_how_it_talks_with_others():
    look = seen(
        node_of('/a', ['/tf'], ['/tf']),
        node_of('/b', [], ['/tf'], pid=2),
        connections=[('/tf', '/a', '/a', 'INTRAPROCESS'), ('/tf', '/a', '/b', 'TCPROS')],
    )
    assert {edge.transports for edge in Graph(look).edges} == {('TCPROS',)}


def test_strange_names_and_problems_break_no_picture():
    odd = dataclasses.replace(
        node_of('/odd', ['/t'], state=DEAD, pid=None),
        uri='http://"<&>\\',
        problem='no "<&>\\ way\n',
    )
    graph = Graph(seen(odd, types={'/t': None}))
    assert 'type unknown' in graph.dot()
    xml.etree.ElementTree.fromstring(graph._repr_svg_())


def test_an_empty_graph_is_a_picture_too():
    graph = Graph(seen())
    xml.etree.ElementTree.fromstring(graph._repr_svg_())
    assert '0 nodes' in graph.text()


def test_a_hundred_nodes_are_drawn_in_seconds():
    nodes = [
        node_of(f'/robot{n % 10}/node{n}', [f'/t{n}'], [f'/t{n - 1}', '/tf'], pid=n // 3)
        for n in range(100)
    ]
    before = time.monotonic()
    picture = Graph(seen(*nodes))._repr_svg_()
    assert time.monotonic() - before < 2 * TIMEOUT
    assert picture.count('class="node"') == 202


def test_what_is_too_tangled_for_frames_is_drawn_without(monkeypatch):
    for_ever = [sys.executable, '-c', 'import time; time.sleep(1000)']
    monkeypatch.setattr(graphviz, 'LAYOUTS', ((for_ever, 0.1), (['sfdp'], 60.0)))
    graph = Graph(seen(node_of('/a', ['/t'])))
    xml.etree.ElementTree.fromstring(graph._repr_svg_())


def test_a_tangle_of_a_hundred_nodes_is_no_strip():
    nodes = [
        node_of(f'/n{n}', [f'/t{n}'], [f'/t{n * 3 % 100 + more}' for more in range(2)], pid=1)
        for n in range(100)
    ]
    box = xml.etree.ElementTree.fromstring(Graph(seen(*nodes))._repr_svg_()).get('viewBox')
    width, height = map(float, box.split()[2:])
    assert width < 3 * height


@pytest.mark.parametrize(
    'options, text',
    [
        ({'hide': 'leafs'}, r"'unreachable', not 'leafs' \(did you mean 'leaf'\?\)"),
        ({'group': 'proces'}, r"did you mean 'process'"),
        ({'seconds': -1}, 'seconds is a number of seconds'),
    ],
)
def test_a_wrong_option_is_refused_with_those_that_there_are(master, options, text):
    with pytest.raises(ValueError, match=text):
        master.graph(**options)


@pytest.mark.parametrize('option', ['namespace', 'hide'])
@pytest.mark.parametrize('value', [3, [3], None, [['leaf']]])
def test_a_namespace_and_what_is_hidden_are_names(master, option, value):
    with pytest.raises(TypeError, match=f'given by its name, .* not as {re.escape(repr(value))}'):
        master.graph(**{option: value})


# -- files


@pytest.mark.parametrize(
    'suffix, beginning',
    [('svg', b'<?xml'), ('png', b'\x89PNG'), ('pdf', b'%PDF'), ('dot', b'digr')],
)
def test_a_picture_is_saved_as_its_suffix_says(tmp_path, suffix, beginning):
    path = tmp_path / f'graph.{suffix}'
    Graph(seen(node_of('/a', ['/t']))).save(path)
    assert path.read_bytes().startswith(beginning)
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_a_link_stays_one_and_the_file_has_the_usual_rights(tmp_path):
    (tmp_path / 'link.dot').symlink_to(tmp_path / 'file.dot')
    Graph(seen()).save(tmp_path / 'link.dot')
    assert (tmp_path / 'link.dot').is_symlink()
    (tmp_path / 'other').touch()
    modes = {stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ('file.dot', 'other')}
    assert len(modes) == 1


def test_another_suffix_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r'graph.jpeg .* \.svg, \.png, \.pdf, \.dot'):
        Graph(seen()).save(tmp_path / 'graph.jpeg')


def test_a_file_that_cannot_be_written_is_named(tmp_path):
    with pytest.raises(PharosError, match='missing/graph.dot cannot be written: No such file'):
        Graph(seen()).save(tmp_path / 'missing' / 'graph.dot')


def test_without_graphviz_it_says_what_to_install_and_dot_works(tmp_path, monkeypatch):
    monkeypatch.setenv('PATH', str(tmp_path))
    graph = Graph(seen())
    with pytest.raises(PharosError, match='apt-get install graphviz'):
        graph.save(tmp_path / 'graph.svg')
    graph.save(tmp_path / 'graph.dot')
    assert not (tmp_path / 'graph.svg').exists()
    said = xml.etree.ElementTree.fromstring(graph._repr_svg_())  # in Jupyter
    assert 'apt-get install graphviz' in ''.join(said.itertext())


def test_a_graph_that_graphviz_cannot_read_is_an_error_of_ours():
    with pytest.raises(PharosError, match='graphviz cannot draw it: .*syntax error'):
        graphviz.render('digraph {', 'svg')


def test_without_a_master_there_is_no_graph():
    with pytest.raises(MasterUnreachableError, match='roscore'):
        Master(refused_url()).graph()


def test_it_is_ready_for_json(master, small):
    read = json.loads(json.dumps(master.graph(services=True).as_dict()))
    assert read['topics']['/picture_a']['type'] == STRING
    assert {'kind': 'hears', 'start': '/picture_a'}.items() <= read['edges'][1].items()


# -- the program


def test_the_program_prints_the_graph(master, small):
    ended = run(master.url, script('graph'))
    assert (ended.returncode, ended.stderr) == (0, '')
    assert '-> /picture_a  std_msgs/String  to /picture_cpp (TCPROS)' in ended.stdout


def test_the_program_saves_a_picture_and_json(master, small, tmp_path):
    path = tmp_path / 'graph.png'
    ended = run(master.url, script('graph'), '--output', str(path), '--services')
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, '', '')
    assert path.read_bytes().startswith(b'\x89PNG')
    read = json.loads(
        run(master.url, script('graph'), '--json', '--namespace', '/picture_cpp').stdout
    )
    assert list(read['nodes']) == ['/picture_cpp']


def test_the_program_draws_again_when_the_graph_changes_and_ends_with_ctrl_c(master, tmp_path):
    create(master, '/picture_one')
    path = tmp_path / 'graph.dot'
    with Program(master.url, script('graph'), '--output', str(path), '--watch') as program:
        until(lambda: path.exists() and '/picture_one' in path.read_text())
        before = path.stat().st_ino
        create(master, '/picture_two')
        until(lambda: '/picture_two' in path.read_text())
        assert path.stat().st_ino != before  # another file took its place, whole
        assert path.read_text().endswith('}\n')
        assert program.end() == 0
        assert program.read_to_the_end() == ''


def test_the_program_waits_for_a_master_that_goes_away_while_it_watches(mortal_master):
    with Program(mortal_master.url, script('graph'), '--watch') as program:
        program.wait_for('0 nodes')
        mortal_master.end()
        program.wait_for('waiting for it')
        mortal_master.come_back()
        create(Master(mortal_master.url), '/picture_one')
        program.wait_for('/picture_one')
        assert program.end() == 0


@pytest.mark.parametrize(
    'arguments, status, text',
    [
        (['--output', '/proc/graph.dot'], 1, 'graph: /proc/graph.dot cannot be written: '),
        (['--output', 'graph.jpeg'], 2, 'end in .svg, .png, .pdf, .dot'),
        (['--output', 'graph.svg', '--json'], 2, 'not both'),
        (['--namespace', '/pictures'], 1, "no node is in /pictures (did you mean '/picture'"),
        (['--rates', '-1'], 2, '--rates is a number of seconds'),
        (['--hide', 'leafs'], 2, "invalid choice: 'leafs'"),
    ],
)
def test_the_program_says_in_a_line_what_was_wrong(master, arguments, status, text):
    create(master, '/picture/one')
    ended = run(master.url, script('graph'), *arguments)
    assert (ended.returncode, ended.stdout) == (status, '')
    assert text in ended.stderr.splitlines()[-1]
    assert 'Traceback' not in ended.stderr


def test_the_program_says_that_there_is_no_master():
    ended = run(refused_url(), script('graph'))
    assert (ended.returncode, len(ended.stderr.splitlines())) == (1, 1)
    assert 'start one with roscore' in ended.stderr


def test_the_program_says_that_graphviz_is_missing(master, tmp_path):
    ended = subprocess.run(
        [sys.executable, script('graph'), '--output', str(tmp_path / 'graph.svg')],
        env=environment(master.url, PATH=str(tmp_path)),
        stderr=subprocess.PIPE,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    assert (ended.returncode, len(ended.stderr.splitlines())) == (1, 1)
    assert 'apt-get install graphviz' in ended.stderr


def test_who_reads_the_program_s_output_may_stop_early(master, small):
    ended = subprocess.run(
        f'"{script("graph")}" | head -n 1; exit "${{PIPESTATUS[0]}}"',
        shell=True,
        executable='/bin/bash',
        env=environment(master.url),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        timeout=TIMEOUT,
        check=False,
    )
    assert (ended.returncode, ended.stderr, len(ended.stdout.splitlines())) == (0, '', 1)


def test_the_document_has_pictures_of_each_size():
    text = (ROOT / 'doc' / 'graph.md').read_text()
    pictures = re.findall(r'\((graph\S*\.svg)\)', text)
    assert len(pictures) >= 3
    for name in pictures:
        xml.etree.ElementTree.parse(ROOT / 'doc' / name)
