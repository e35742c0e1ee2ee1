"""Share a connection: subscriptions of several nodes that hear one topic of one node elsewhere, by TCPROS.

rospy makes the connection of the first one. It is then in the lists of all of them, and ends when the
last one closes.
"""
from __future__ import annotations

import threading
from typing import Any
from weakref import WeakValueDictionary

from rospy.impl.transport import Transport

from pharos.intraprocess.copier import copy_of
from pharos.intraprocess.links import runs_lock

#: (URL of the master, URI of the publisher, topic, message class) -> Share. Its connection keeps the
#: Share alive; until there is one, who connects does
_shares: WeakValueDictionary[tuple, Share] = WeakValueDictionary()
# of a connection that is shared: its Share, and the subscriptions that hear it
Transport.share = None  # type: ignore[attr-defined]
Transport.subscriptions = ()  # type: ignore[attr-defined]


class Share:
    """The place where subscriptions of one topic of a node elsewhere find their connection.

    :ivar connection: the newest one, or None
    :ivar lock: held while a subscription connects, joins or leaves, and while a message is delivered:
        one that joins gets the latched message once, before the next one. Who has it runs no callback
    """

    connection: Any = None

    def __init__(self) -> None:
        self.lock = threading.Lock()

    def join(self, subscription: Any) -> bool:
        """Have a subscription hear the connection; return False if there is none."""
        connection = self.connection
        if not connection or connection.done:
            return False
        if self.add(subscription, connection) and connection.latch is not None:
            subscription.give([subscription], copy_of(connection.latch), connection, 0)
        return True

    def add(self, subscription: Any, connection: Any) -> bool:
        """Add a connection to a subscription; return False if that is closed, or has one."""
        connection.share = self  # before the thread that reads can find the subscription
        with subscription.c_lock:  # or leave() could look for connections before it is there
            if subscription.is_leaving or subscription.has_connection(connection.endpoint_id):
                return False
            subscription.rospy_add_connection(connection)
        connection.subscriptions = [*connection.subscriptions, subscription]
        # the thread that reads takes it out of all lists; rospy's callback is that of one list
        connection.set_cleanup_callback(None)
        self.connection = connection
        return True


def share_of(subscription: Any, uri: str) -> Share | None:
    """Return the Share of a topic of the publisher at a URI, None if the node's Master has none."""
    master = subscription.run.master
    if not master.share_connections:
        return None
    key = master.url, uri, subscription.resolved_name, subscription.data_class
    with runs_lock:  # setdefault() is in Python here: two threads would get one each
        return _shares.setdefault(key, Share())


def end(connection: Any) -> tuple:
    """Close a connection, and return the subscriptions that have shared it, perhaps none."""
    if not connection.share:
        connection.close()
        return ()
    with connection.share.lock:  # nobody joins any more
        connection.close()
        subscriptions = connection.subscriptions
        connection.subscriptions = ()
        if connection.share.connection is connection:
            connection.share.connection = None
        return subscriptions


def leave(subscription: Any) -> None:
    """Take a subscription, which closes, out of connections that others hear, too."""
    with subscription.c_lock:
        subscription.is_leaving = True
        connections = subscription.connections
    for connection in connections:
        if connection.share:
            with connection.share.lock:
                others = [each for each in connection.subscriptions if each is not subscription]
                if others:
                    connection.subscriptions = others
                    subscription.connections = [
                        each for each in subscription.connections if each is not connection
                    ]
                else:  # before another one joins
                    connection.close()
