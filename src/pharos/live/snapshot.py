"""Take one look at the graph of a master: nodes, topics, services, connections and their counts."""
import collections
import concurrent.futures
import dataclasses
import time
import urllib.parse
from typing import Any, NamedTuple

import rosgraph.network

from pharos.private_rospy.run import ServerProxy

TIMEOUT = 1.0  # seconds that a node has for each answer
THREADS = 50  # nodes that are asked at once


class Link(NamedTuple):
    """A connection from one node to another."""

    topic: str
    publisher: str  # the name of a node; its URI if the master knows none there
    subscriber: str
    transport: str  # 'INTRAPROCESS', 'TCPROS' or 'UDPROS'


@dataclasses.dataclass
class SeenNode:
    """A node, and what it says of itself."""

    name: str
    uri: str = ''
    host: str = ''
    pid: int | None = None  # None: it does not say
    problem: str = ''  # why it does not answer
    #: messages and bytes of its connections: (is incoming, topic, other end, transport) -> both
    ends: dict[tuple, tuple[int, int]] = dataclasses.field(default_factory=dict)
    health: dict[str, Any] = dataclasses.field(default_factory=dict)  # nodes of pharos tell it
    publishes: list[str] = dataclasses.field(default_factory=list)
    subscribes: list[str] = dataclasses.field(default_factory=list)
    offers: list[str] = dataclasses.field(default_factory=list)


@dataclasses.dataclass
class Snapshot:
    """The graph of a master at a time."""

    master: str  # its URL
    time: float  # seconds, as of time.time()
    nodes: dict[str, SeenNode]
    topics: dict[str, str]  # and their types; '' if nobody has named it
    links: dict[Link, tuple[int, int]]  # messages and bytes so far

    def rates_since(self, before):
        """Return messages and bytes a second of the connections that both have."""
        seconds, rates = self.time - before.time, {}
        for link, now in self.links.items():
            then = before.links.get(link)
            if then and now[0] >= then[0]:
                rates[link] = (now[0] - then[0]) / seconds, (now[1] - then[1]) % 2**32 / seconds
        return rates


def take(master):
    """Ask the master, and all nodes at once.

    :raises MasterUnreachableError: if the master does not answer
    """
    nodes: dict[str, SeenNode] = {}
    types = dict(master.call('getTopicTypes'))
    for kind, uses in zip(('publishes', 'subscribes', 'offers'), master.system_state()):
        for what, users in sorted(uses.items()):
            for name in sorted(set(users)):
                getattr(nodes.setdefault(name, SeenNode(name)), kind).append(what)
    topics = {topic for node in nodes.values() for topic in (*node.publishes, *node.subscribes)}
    with concurrent.futures.ThreadPoolExecutor(THREADS) as pool:
        list(pool.map(lambda node: _ask(master, node), nodes.values()))
    seen = {topic: types.get(topic, '').replace('*', '') for topic in sorted(topics)}
    return Snapshot(master.url, time.time(), dict(sorted(nodes.items())), seen, _links(nodes))


def _ask(master, node):
    """Fill in what a node says of itself."""
    try:
        node.uri = master.call('lookupNode', node.name) or ''
        node.host = urllib.parse.urlsplit(node.uri).hostname or ''
        if rosgraph.network.is_local_address(node.host):
            node.host = 'here'
        api = ServerProxy(node.uri, TIMEOUT)
        node.pid = int(api.getPid('/pharos')[2])
        answer = api.getBusStats('/pharos')
        published, subscribed, *_ = answer[2] if answer[0] == 1 else answer  # roscpp has no code
        counts = {}  # as rospy's and roscpp's rows have them
        for topic, *_, rows in published:  # rospy has a count of bytes between them
            counts.update({(False, topic, row[0]): (row[-2], row[1]) for row in rows})
        for topic, rows in subscribed:
            counts.update({(True, topic, row[0]): (row[2], row[1]) for row in rows})
        for number, other, direction, transport, topic, *_ in api.getBusInfo('/pharos')[2]:
            is_incoming = direction == 'i'
            found = counts.get((is_incoming, topic, number), (0, 0))
            node.ends[is_incoming, topic, other, transport] = found
        node.health = api.pharosHealth('/pharos')[2]
    except Exception as error:  # whatever it answers, it is one of many
        if 'pharosHealth' not in str(error):  # else it is not a node of pharos
            node.problem = str(error)


def health_facts(run):
    """Return the facts of :meth:`Node.health` that the master is not asked for."""
    transports = [info[3] for info in run.topics.get_pub_sub_info()]
    ended_souls = [soul.name for soul in run.souls if not soul.is_alive()]
    return {
        'kind': type(run.node).__name__,
        'connections': dict(collections.Counter(transports)),
        'dropped': sum(getattr(each, 'dropped', 0) for each in run.open_endpoints(object)),
        'errors': run.failures.total,
        'threads': sum(thread.is_alive() for thread in list(run.threads)),
        'souls': len(run.souls) - len(ended_souls),
        'ended_souls': ended_souls,
    }


def _links(nodes):
    """Return the connections that one end at least tells, with the greater count of both.

    A publisher names the other end by its node, a subscriber by its URI.
    """
    names = {node.uri: node.name for node in nodes.values()}
    links = collections.defaultdict(lambda: (0, 0))
    for node in nodes.values():
        for (is_incoming, topic, other, transport), counts in node.ends.items():
            peer = names.get(other, other)
            ends = (peer, node.name) if is_incoming else (node.name, peer)
            link = Link(topic, *ends, transport)
            links[link] = max(links[link], counts)
    return dict(links)


def topic_rates(before, now, what=0):
    """Return ``{topic: messages (1: bytes) a second}``: the best connection of each publisher."""
    best: dict[tuple[str, str], float] = collections.defaultdict(float)
    for link, rate in now.rates_since(before).items() if now is not before else ():
        best[link[:2]] = max(best[link[:2]], rate[what])
    rates: dict[str, float] = collections.defaultdict(float)
    for (topic, _), most in best.items():
        rates[topic] += most
    return dict(rates)
