"""The arrows of a graph."""
import dataclasses
from typing import Tuple

PUBLISHES = 'publishes'  # from a node to a topic
HEARS = 'hears'  # from a topic to a node
OFFERS = 'offers'  # from a node to a service
SENDS = 'sends'  # from a node to another, where a graph has nodes only


@dataclasses.dataclass(frozen=True)
class Edge:
    """An arrow of a graph."""

    kind: str  # PUBLISHES, HEARS, OFFERS or SENDS
    start: str  # the name of a node, or of a topic where it is HEARS
    end: str  # of a topic, a service or a node
    transports: Tuple[str, ...]  # by which messages go; none where nothing is connected
    topics: Tuple[str, ...]  # that it is about
