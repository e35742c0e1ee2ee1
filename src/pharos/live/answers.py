"""What the nodes of a graph say of themselves, asked all at once within one time limit."""
import dataclasses
import os
import socket
import threading
import time
import urllib.parse
import xmlrpc.client
from typing import Any, Dict, List, NamedTuple, Optional, Set, Tuple

import rosgraph
import rosgraph.network

from pharos.errors import PharosError
from pharos.external_node import node_api
from pharos.node import Node

ALIVE = 'alive'
SILENT = 'silent'  # it does not answer in time: too busy, stopped by a debugger, or out of reach
DEAD = 'dead'  # nobody is at its address any more, though the master has it still

CALLER = '/pharos'
INBOUND = 'i'  # the direction of a connection, in getBusInfo
WRAP = 2**32  # bytes after which nodes count from the beginning


@dataclasses.dataclass(frozen=True)
class Count:
    """What one end of a connection has counted since it was made."""

    #: the URI of the node that counts, and the number by which it knows the connection; of both,
    #: where two nodes have two
    of: Tuple[Tuple[str, int], ...]
    messages: int
    bytes: int
    time: float  # when the node had said so, in seconds as of time.monotonic()

    def __add__(self, other: 'Count') -> 'Count':
        return Count(
            tuple(sorted(self.of + other.of)),
            self.messages + other.messages,
            self.bytes + other.bytes,
            max(self.time, other.time),
        )

    def rates_since(self, before: 'Count') -> Optional[Tuple[float, float]]:
        """Messages and bytes a second since an earlier look; None: it has been connected anew."""
        seconds = self.time - before.time
        if self.of != before.of or self.messages < before.messages or seconds <= 0:
            return None
        size = (self.bytes - before.bytes) % WRAP
        return (self.messages - before.messages) / seconds, size / seconds


class End(NamedTuple):
    """One end of a connection, as its node tells it."""

    is_inbound: bool
    topic: str
    other: str  # the name or the URI of the node at the other end
    transport: str
    counted: Optional[Count]  # None: it does not say, or was not asked


@dataclasses.dataclass
class Answer:
    """What a node has said so far; filled in by a thread of its own."""

    host: str  # as the node calls it
    address: Optional[str] = None  # of the host; None: not known
    is_here: bool = False
    pid: Optional[int] = None
    ends: Optional[List[End]] = None
    health: Optional[Dict[str, Any]] = None  # what a node of pharos tells, if it was asked
    error: Optional[Exception] = None

    @property
    def state(self) -> str:
        """ALIVE, SILENT or DEAD."""
        if self.ends is not None:
            return ALIVE
        is_dead = isinstance(self.error, (ConnectionRefusedError, socket.gaierror))
        return DEAD if is_dead else SILENT

    @property
    def problem(self) -> str:
        """Why it is not ALIVE."""
        if self.ends is not None:
            return ''
        return 'it has not answered in time' if self.error is None else str(self.error)


def ask_all(
    uris: Dict[str, Optional[str]],
    own: Dict[str, Node],
    timeout: float,
    counts: bool,
    plain: Optional[Set[str]] = None,
) -> Dict[str, Answer]:
    """What the nodes at these URIs say until ``timeout`` seconds are over.

    Each has a thread, which is left to itself where it takes longer: looking up the name of a host
    has no limit of its own.

    :param counts: whether they are to say what they have counted
    :param plain: the URIs of nodes known not to be of pharos; all others are asked for their health
        then, and those found out not to be of pharos are added
    """
    deadline = time.monotonic() + timeout
    answers = {name: Answer(_host_name(uri)) for name, uri in uris.items()}
    threads = [
        threading.Thread(
            target=_ask,
            args=(answers[name], uri, own.get(name), timeout, counts, plain),
            name=f'snapshot of {name}',
            daemon=True,
        )
        for name, uri in uris.items()
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(max(0.0, deadline - time.monotonic()))
    return {name: dataclasses.replace(answer) for name, answer in answers.items()}


def _ask(
    answer: Answer,
    uri: Optional[str],
    own: Optional[Node],
    timeout: float,
    counts: bool,
    plain: Optional[Set[str]],
) -> None:
    """Fill in the answer of a node, for up to ``timeout`` seconds a call."""
    try:
        if uri is None:
            raise ConnectionRefusedError('the master does not know it any more')
        if own is not None:
            answer.is_here, answer.pid = True, os.getpid()
            rospy = own.current_run.rospy
            counted = _counts(rospy.topics.get_pub_sub_stats(), uri) if counts else {}
            answer.ends = _ends(rospy.topics.get_pub_sub_info(), counted)
            answer.health = None if plain is None else rospy.tell_health()
            return
        answer.is_here, answer.address = _locate(answer.host)
        api = node_api(uri, timeout)
        answer.pid = _pid(_value(api.getPid(CALLER)))
        bus_info = _value(api.getBusInfo(CALLER))
        answer.ends = _ends(bus_info, {})
        if counts:
            answer.ends = _ends(bus_info, _counts(_bus_stats(api), uri))
        if plain is not None and uri not in plain:
            answer.health = _health(api, uri, plain)
    except Exception as error:  # whatever it answers, it is one node of many
        answer.error = error


def _health(api: Any, uri: str, plain: Set[str]) -> Optional[Dict[str, Any]]:
    """What a node of pharos tells of its health; None, and added to ``plain``: it is none."""
    try:
        health = _value(api.pharosHealth(CALLER))
        counts = [health[name] for name in ('threads', 'souls', 'failures')]
        _check(str, health['class'], *health['dropped'])
        _check(int, *counts, *health['dropped'].values())
        return dict(health)
    except xmlrpc.client.Fault:  # it has no such method
        plain.add(uri)
        return None


def _bus_stats(api: Any) -> Any:
    """``(of what it publishes, of what it hears, ...)``; roscpp leaves out code and text."""
    answer = api.getBusStats(CALLER)
    return _value(answer) if answer[:1] == [1] else answer


def _value(answer: Any) -> Any:
    """The value in an answer of ROS's slave API: a code (1: done), a text, the value."""
    code, text, value = answer
    if code != 1:
        raise PharosError(str(text))
    return value


def _pid(given: Any) -> int:
    pid = int(given)
    if not 0 < pid < 2**31:
        raise ValueError(f'its process cannot have the number {pid}')
    return pid


def _check(kind: Any, *values: Any) -> None:
    """What a node says goes to all who look at the graph: complain of what is no ``kind``."""
    for value in values:
        if not isinstance(value, kind):
            raise ValueError(f'it has answered {value!r} where {kind.__name__} is due')


def _ends(bus_info: Any, counts: Dict[Tuple[bool, str, int], Count]) -> List[End]:
    """The ends of connections that a node tells by getBusInfo."""
    for _, other, direction, transport, topic, *_ in bus_info:
        _check(str, other, direction, transport, topic)
    return [
        End(
            direction == INBOUND,
            topic,
            other,
            transport,
            counts.get((direction == INBOUND, topic, number)),
        )
        for number, other, direction, transport, topic, *more in bus_info
        if not more or more[0]  # else it is not connected (yet)
    ]


def _counts(bus_stats: Any, uri: str) -> Dict[Tuple[bool, str, int], Count]:
    """``{(whether it is inbound, topic, its number): Count}``, of a node that has just told them by
    getBusStats.

    Of a topic that it publishes, rospy tells one thing more than roscpp, and roscpp one more of
    each connection.
    """
    now = time.monotonic()
    published, subscribed, *_ = bus_stats
    found = {}
    for topic, *_, connections in published:
        for number, size, *messages, _ in connections:
            _check(int, number, size, messages[-1])
            found[False, topic, number] = Count(((uri, number),), messages[-1], size, now)
    for topic, connections in subscribed:
        for number, size, messages, *_ in connections:
            _check(int, number, size, messages)
            found[True, topic, number] = Count(((uri, number),), messages, size, now)
    return found


def _host_name(uri: Optional[str]) -> str:
    try:
        return urllib.parse.urlsplit(uri or '').hostname or 'unknown'
    except ValueError:  # it is no URI
        return 'unknown'


def _locate(host: str) -> Tuple[bool, str]:
    """``(whether it is this computer, its address)``."""
    address = str(socket.getaddrinfo(host, None)[0][4][0])
    return rosgraph.network.is_local_address(host), address
