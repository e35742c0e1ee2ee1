"""Take a snapshot of a master and its nodes: topics, services, links and their messages."""
from __future__ import annotations

import concurrent.futures
import time
import urllib.parse
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import rosgraph.network

from pharos.private_rospy.xmlrpc import CALLER_ID, ServerProxy

if TYPE_CHECKING:
    from pharos.master import Master

NODE_TIMEOUT = 1.0  # seconds that a node has for each answer
MAX_THREADS = 50  # nodes that are asked at once
LOCAL_HOST = 'here'  # stands for every address of this host
#: the lists of a NodeReport, in the order of the master's getSystemState
REGISTRIES = 'publishes', 'subscribes', 'offers'


class Link(NamedTuple):
    """A connection from one node to another."""

    topic: str
    publisher: str  # a node's name, or its URI if the master knows no node there
    subscriber: str
    transport: str  # 'INTRAPROCESS', 'SHARED_MEMORY', 'TCPROS' or 'UDPROS'


@dataclass
class NodeReport:
    """A node, as the master and the node itself report it."""

    name: str
    uri: str = ''
    host: str = ''
    pid: int | None = None  # None: unknown
    problem: str = ''  # the reason why the node does not answer
    links: dict[Link, int] = field(default_factory=dict)  # link -> messages; publishers are URIs
    health: dict[str, Any] = field(default_factory=dict)  # empty: no node of pharos
    publishes: list[str] = field(default_factory=list)
    subscribes: list[str] = field(default_factory=list)
    offers: list[str] = field(default_factory=list)


@dataclass
class Snapshot:
    """The nodes, topics and links of a master at one time."""

    master: str  # its URL
    time: float  # seconds, as of time.time()
    nodes: dict[str, NodeReport]
    topic_types: dict[str, str]  # '*' for a topic that has only subscribers, of any type
    links: dict[Link, int]  # link -> messages; of a link, those of its publisher

    def rates_since(self, start: Snapshot) -> dict[Link, float]:
        """Return the messages in one second of the links that both snapshots have."""
        seconds = self.time - start.time
        return {
            link: (count - start.links[link]) / seconds
            for link, count in self.links.items()
            # a link that counts fewer messages than before is a new one
            if count >= start.links.get(link, count + 1)
        }


def take_snapshot(master: Master) -> Snapshot:
    """Ask the master, then all nodes at once.

    :raises MasterUnreachableError: if the master does not answer
    """
    topic_types = dict(master.call('getTopicTypes'))
    nodes: dict[str, NodeReport] = {}
    for registry, registrations in zip(REGISTRIES, master.system_state()):
        for name, users in sorted(registrations.items()):
            for user in users:
                node = nodes.setdefault(user, NodeReport(user))
                getattr(node, registry).append(name)
    with concurrent.futures.ThreadPoolExecutor(MAX_THREADS) as pool:
        list(pool.map(lambda node: _ask_node(master, node), nodes.values()))
    links = _merge_links(nodes.values())
    return Snapshot(master.url, time.time(), dict(sorted(nodes.items())), topic_types, links)


def _ask_node(master, node):
    """Fill in the address, process, links and health of a node."""
    try:
        node.uri = master.call('lookupNode', node.name) or ''
        node.host = urllib.parse.urlsplit(node.uri).hostname or ''
        if rosgraph.network.is_local_address(node.host):
            node.host = LOCAL_HOST
        proxy: Any = ServerProxy(node.uri, NODE_TIMEOUT)
        node.pid = int(proxy.getPid(CALLER_ID)[2])
        counts = _message_counts(proxy.getBusStats(CALLER_ID))
        for number, peer, direction, transport, topic, *_ in proxy.getBusInfo(CALLER_ID)[2]:
            is_incoming = direction == 'i'
            if is_incoming:
                link = Link(topic, peer, node.name, transport)
            else:
                link = Link(topic, node.name, peer, transport)
            node.links[link] = counts.get((is_incoming, topic, number), 0)
        node.health = proxy.pharosHealth(CALLER_ID)[2]
    except Exception as error:  # a node with a problem must not hide the others
        if 'pharosHealth' not in str(error):  # only nodes of pharos have this method
            node.problem = str(error)


def _message_counts(answer):
    """Return ``{(is incoming, topic, number of the connection): messages}`` from getBusStats."""
    has_code = answer[0] == 1  # roscpp leaves out code and message
    publications, subscriptions, *_ = answer[2] if has_code else answer
    counts = {}
    for topic, *_, rows in publications:  # rospy has the sum of bytes before the rows
        for row in rows:  # the count of messages is third in rospy's rows, fourth in roscpp's
            counts[False, topic, row[0]] = row[-2]
    for topic, rows in subscriptions:
        for number, _, message_count, *_ in rows:
            counts[True, topic, number] = message_count
    return counts


def _merge_links(nodes):
    """Return the links that one end at least reports, with the greater count of both.

    A publisher reports the name of the other end, a subscriber the URI.
    """
    names = {node.uri: node.name for node in nodes}
    links: dict[Link, int] = {}
    for node in nodes:
        for link, count in node.links.items():
            publisher = names.get(link.publisher, link.publisher)
            subscriber = names.get(link.subscriber, link.subscriber)
            merged_link = Link(link.topic, publisher, subscriber, link.transport)
            links[merged_link] = max(links.get(merged_link, 0), count)
    return links


def publisher_rates(link_rates: dict[Link, float]) -> dict[tuple[str, str], float]:
    """Return ``{(topic, publisher): messages in one second}``, those of the fastest link."""
    rates: dict[tuple[str, str], float] = {}
    for link, rate in link_rates.items():
        key = link.topic, link.publisher
        rates[key] = max(rates.get(key, 0.0), rate)
    return rates
