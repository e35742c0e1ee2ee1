"""The callback by which rospy hands a receiver what comes through sockets."""
import threading

from pharos.intraprocess.copier import copier_for, serialized
from pharos.private_rospy.refusals import suits


class SocketCallback:
    """Puts messages from rospy, which runs the dispatcher after a batch of them, into an inbox.

    :param receiver: a :class:`pharos.intraprocess.inbox.Receiver`
    :param node: its PrivateRospy
    """

    def __init__(self, receiver, inbox, node):
        self._receiver, self._inbox, self._node = receiver, inbox, node
        self._size = copier_for(receiver.message_class).size
        self._lock = threading.Lock()  # TCPROS connections call side by side

    def __call__(self, message):
        receiver = self._receiver
        from_ = receiver.from_
        if from_ is not None and message._connection_header.get('callerid') != from_:
            return
        # the first subscriber of the node, which rospy goes by, may want another class: AnyMsg, say
        if message.__class__ is not receiver.message_class:
            header = message._connection_header
            if not suits(receiver.message_class, header['md5sum']):
                subscription = self._node.subscriber(receiver.topic)
                if subscription is not None:
                    self._node.refusals.message_refused(
                        subscription, receiver.message_class, header
                    )
                return
            message = receiver.message_class().deserialize(serialized(message))
            message._connection_header = header
        with self._lock:
            self._inbox.put(message, self._size(message) if self._size else 0)
