"""Subscriptions to many topics at once, for who wants their rates measured."""
import time
from typing import Collection, Dict, Tuple

from pharos.live.watching import create_looker
from pharos.master import Master
from pharos.probe import Probe


class Probes:
    """A node with a probe for each topic that is to be measured; it is made when it is needed."""

    def __init__(self, master: Master) -> None:
        self._node = create_looker(master)
        self._probes: Dict[str, Probe] = {}
        self._since: Dict[str, float] = {}  # when each began to count, by time.perf_counter()

    @property
    def name(self) -> str:
        """That of its node."""
        return self._node.name

    def measure(self, topics: Collection[str]) -> Dict[str, Tuple[float, float]]:
        """``{topic: (messages a second, bytes a second)}`` since the last time, for those that it
        was asked for then, too; it goes on to measure these topics."""
        found = {}
        for topic in set(self._probes) - set(topics):
            self._probes.pop(topic).close()
        for topic in topics:
            probe = self._probes.get(topic)
            if probe is None:
                probe = self._probes[topic] = Probe(self._node, topic, weighs=True)
            else:
                found[topic] = _rates(probe, time.perf_counter() - self._since[topic])
            probe.restart()
            self._since[topic] = time.perf_counter()
        return found

    def close(self) -> None:
        """End it."""
        self._node.stop()


def _rates(probe: Probe, seconds: float) -> Tuple[float, float]:
    count, sizes = len(probe.times), probe.sizes
    mean = sum(sizes) / len(sizes) if sizes else 0.0
    return count / seconds, mean * count / seconds
