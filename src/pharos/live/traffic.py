"""What goes through the connections of a graph, a second: from what nodes count in two looks."""
from typing import Any, Dict, Iterable, Tuple

from pharos.live.snapshot import Connection


class Traffic:
    """What has gone through connections between two looks, a second.

    Of a topic that nobody hears nothing is counted, and so nothing told.
    """

    def __init__(self, before: Iterable[Connection], after: Iterable[Connection]) -> None:
        #: (topic, publisher) -> messages, bytes: those of its best connection
        self.published: Dict[Tuple[str, str], Tuple[float, float]] = {}
        #: (topic, subscriber) -> messages, of all its publishers
        self.heard: Dict[Tuple[str, str], float] = {}
        #: topic -> messages, of all its publishers; bytes that one subscriber gets
        self.of_topic: Dict[str, float] = {}
        self.bandwidth: Dict[str, float] = {}
        #: node -> messages, bytes
        self.received: Dict[str, float] = {}
        self.sent: Dict[str, float] = {}
        self.bytes_received: Dict[str, float] = {}
        self.bytes_sent: Dict[str, float] = {}
        former = {each.key: each for each in before}
        for each in after:
            found = each.rates_since(former.get(each.key))
            if found is not None:
                self._add_connection(each, *found)
        for (topic, publisher), (rate, size) in self.published.items():
            _add(self.of_topic, topic, rate)
            _add(self.bandwidth, topic, size)
            _add(self.sent, publisher, rate)

    def _add_connection(self, connection: Connection, rate: float, size: float) -> None:
        ends = connection.topic, connection.publisher
        best = self.published.get(ends, (0.0, 0.0))
        self.published[ends] = max(best[0], rate), max(best[1], size)
        _add(self.heard, (connection.topic, connection.subscriber), rate)
        _add(self.received, connection.subscriber, rate)
        _add(self.bytes_received, connection.subscriber, size)
        _add(self.bytes_sent, connection.publisher, size)


def _add(values: Dict[Any, float], key: Any, value: float) -> None:
    values[key] = values.get(key, 0.0) + value
