"""What the nodes of a graph say of themselves, asked all at once within one time limit."""
import dataclasses
import os
import socket
import threading
import time
import urllib.parse
from typing import Any, Dict, List, NamedTuple, Optional, Tuple

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


class End(NamedTuple):
    """One end of a connection, as its node tells it."""

    is_inbound: bool
    topic: str
    other: str  # the name or the URI of the node at the other end
    transport: str
    counts: Dict[str, int]  # fields of a Connection


@dataclasses.dataclass
class Answer:
    """What a node has said so far; filled in by a thread of its own."""

    host: str  # as the node calls it
    address: Optional[str] = None  # of the host; None: not known
    is_here: bool = False
    pid: Optional[int] = None
    ends: Optional[List[End]] = None
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
    uris: Dict[str, Optional[str]], own: Dict[str, Node], timeout: float, counts: bool
) -> Dict[str, Answer]:
    """What the nodes at these URIs say until ``timeout`` seconds are over.

    Each has a thread, which is left to itself where it takes longer: looking up the name of a host
    has no limit of its own.
    """
    deadline = time.monotonic() + timeout
    answers = {name: Answer(_host_name(uri)) for name, uri in uris.items()}
    threads = [
        threading.Thread(
            target=_ask,
            args=(answers[name], uri, own.get(name), timeout, counts),
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
    answer: Answer, uri: Optional[str], own: Optional[Node], timeout: float, counts: bool
) -> None:
    """Fill in the answer of a node, for up to ``timeout`` seconds a call."""
    try:
        if uri is None:
            raise ConnectionRefusedError('the master does not know it any more')
        if own is not None:
            answer.is_here, answer.pid = True, os.getpid()
            topics = own.current_run.rospy.topics
            stats = topics.get_pub_sub_stats() if counts else None
            answer.ends = _ends(topics.get_pub_sub_info(), stats)
            return
        answer.is_here, answer.address = _locate(answer.host)
        api = node_api(uri, timeout)
        answer.pid = int(_value(api.getPid(CALLER)))
        bus_info = _value(api.getBusInfo(CALLER))
        answer.ends = _ends(bus_info, None)
        if counts:
            answer.ends = _ends(bus_info, _bus_stats(api))
    except Exception as error:  # whatever it answers, it is one node of many
        answer.error = error


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


def _ends(bus_info: Any, bus_stats: Any) -> List[End]:
    """The ends of connections that a node tells by getBusInfo, and by getBusStats, if it was
    asked."""
    counts = _counts(bus_stats) if bus_stats else {}
    return [
        End(
            direction == INBOUND,
            topic,
            other,
            transport,
            counts.get((direction == INBOUND, topic, number), {}),
        )
        for number, other, direction, transport, topic, *more in bus_info
        if not more or more[0]  # else it is not connected (yet)
    ]


def _counts(bus_stats: Any) -> Dict[Tuple[bool, str, int], Dict[str, int]]:
    """``{(whether it is inbound, topic, its number): {field of a Connection: count}}``.

    Of a topic that it publishes, rospy tells one thing more than roscpp, and roscpp one more of
    each connection.
    """
    published, subscribed, *_ = bus_stats
    found = {}
    for topic, *_, connections in published:
        for number, count, *messages, _ in connections:
            found[False, topic, number] = {'sent': messages[-1], 'bytes_sent': count}
    for topic, connections in subscribed:
        for number, count, messages, *_ in connections:
            found[True, topic, number] = {'received': messages, 'bytes_received': count}
    return found


def _host_name(uri: Optional[str]) -> str:
    return urllib.parse.urlsplit(uri or '').hostname or 'unknown'


def _locate(host: str) -> Tuple[bool, str]:
    """``(whether it is this computer, its address)``."""
    address = str(socket.getaddrinfo(host, None)[0][4][0])
    return rosgraph.network.is_local_address(host), address
