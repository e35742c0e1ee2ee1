"""A connection between a publisher and a subscription of two nodes of this process."""
from typing import Any, Dict, Iterable, List, Optional, Type

import genpy

from pharos.intraprocess.copier import thawer
from pharos.intraprocess.inbox import Inbox, Receiver


class Link:
    """Has an inbox for each receiver of a subscription that hears the publisher.

    :param message_class: the publisher's
    :param header: the ``_connection_header`` of the messages
    """

    def __init__(self, message_class: Type[genpy.Message], header: Dict[str, str]) -> None:
        self.header = header
        self.is_closed = False
        self.inboxes: Dict[Receiver, Inbox] = {}
        self._message_class = message_class

    def receivers(self) -> Iterable[Receiver]:
        """Those that there are now; each is the same object as long as it is there."""
        raise NotImplementedError

    def match_receivers(self) -> List[Inbox]:
        """Have an inbox for each receiver that there is now; returns the new ones.

        The publisher calls this with its lock.
        """
        before = self.inboxes
        self.inboxes = {
            receiver: before.get(receiver)
            or receiver.open_inbox(thawer(self._message_class, receiver.message_class), self.header)
            for receiver in self.receivers()
        }
        for receiver in before.keys() - self.inboxes.keys():
            before[receiver].close()
        if self.is_closed:  # meanwhile, and has not seen those opened since
            self.close_inboxes()
        return [inbox for receiver, inbox in self.inboxes.items() if receiver not in before]

    def close_inboxes(self) -> None:
        """Nothing more arrives."""
        self.is_closed = True
        for inbox in tuple(self.inboxes.values()):
            inbox.close()


def links_of(connections: Optional[Iterable[Any]]) -> List[Any]:
    """The links among the connections of a publisher or a subscription, None of one that is
    closed."""
    return [connection.link for connection in connections or () if hasattr(connection, 'link')]
