"""The examples as programs, and the pictures of their graphs: for test_examples.py and
tools/pictures."""
import dataclasses
import re
import sys
import xml.etree.ElementTree

import pharos
from pharos.live import graphviz, snapshot
from pharos.live.dot import dot_of
from pharos.live.graph import Graph
from pharos.lookers import is_looker
from programs import ROOT, Program

EXAMPLES = ROOT / 'examples'
NAMES = sorted(path.stem for path in EXAMPLES.glob('*.py'))
#: what an example prints when all of its graph is there, or soon will be
READY = {
    'action': '...',
    'busy_service': 'busy',
    'camera': 'the ball',
    'replay': 'replay 1',
    'supervisor': 'restarts',
    'transforms': 'the camera',
    'two_robots': 'is joined',
}
#: of whose picture services are a part
WITH_SERVICES = ('busy_service',)
URL = 'http://localhost:11311/'  # the master's in all pictures


def path_of(name):
    """The program."""
    return EXAMPLES / f'{name}.py'


def started(name, url):
    """The example as a Program, at the master of that URL unless it has masters of its own."""
    return Program(url, sys.executable, str(path_of(name)), ROS_PACKAGE_PATH=str(ROOT))


def masters_of(name, program, url):
    """``{picture: master}`` of the graph of an example, or of those of its own masters, which it
    tells."""
    count = path_of(name).read_text().count('Master.embedded()')
    if not count:
        return {picture_of(name): pharos.Master(url)}
    urls = [program.wait_for('ROS_MASTER_URI=').split()[0].partition('=')[2] for _ in range(count)]
    return {
        picture_of(name, index if count > 1 else 0): pharos.Master(url)
        for index, url in enumerate(urls, 1)
    }


def picture_of(name, index=0):
    """Where the picture is; of an example with several masters, that of the one with that index."""
    return EXAMPLES / (f'{name}-{index}.svg' if index else f'{name}.svg')


def look(name, master):
    """The graph of an example in graphviz's language, without what differs from one run to the
    next: numbers of processes and ports, the time, and the name of this host."""
    seen = snapshot.take(master)
    numbers, processes = {}, {}
    for node in seen.nodes.values():
        if not is_looker(node.name):
            number = numbers.setdefault(node.pid, len(numbers) + 1)
            processes.setdefault(number, []).append(node.name)
    nodes = {
        name: dataclasses.replace(node, uri=None, host='here', pid=numbers.get(node.pid))
        for name, node in seen.nodes.items()
    }
    hosts = [
        snapshot.Host('here', True, [snapshot.Process(*process) for process in processes.items()])
    ]
    same = dataclasses.replace(seen, master=URL, time=0, nodes=nodes, hosts=hosts)
    return re.sub(
        f'{URL}, [-0-9]+ [0-9]+:[0-9]+:[0-9]+',
        URL,
        dot_of(Graph(same, services=name in WITH_SERVICES)),
    )


def said(dot):
    """What a graph says of each of its nodes, topics and arrows, and of how messages go."""
    return {text for text in re.findall(r'tooltip="([^"]*)"', dot)}


def said_by_picture(path):
    """The same, of a picture."""
    titles = [
        element.get('{http://www.w3.org/1999/xlink}title')
        for element in xml.etree.ElementTree.parse(path).iter()
    ]
    return {title for title in titles if title is not None}


def draw(dot, path):
    """Write the picture."""
    graphviz.save(dot, path)
