"""rospy's subscriptions: they lose neither links nor callbacks, and hear links of this process; and
what all topics have."""
import select
import traceback

from pharos.intraprocess.link import links_of
from pharos.private_rospy.plain_receivers import plain_callbacks
from pharos.private_rospy.socket_callback import SocketCallback
from pharos.private_rospy.patches.table import addition, patch, substitute
from pharos.private_rospy import registration
from pharos.signals import is_from_signal

LEFT = select.POLLHUP | select.POLLERR | select.POLLRDHUP  # what a socket says whose peer has gone
RECONNECT_DELAY = 0.05  # seconds; a publisher that accepts and closes at once is not to be stormed


@patch('rospy.topics', '_SubscriberImpl.__init__', 'does not know its publishers')
def init_subscriber(self, name, data_class, *, original):
    """Have room for them."""
    original(self, name, data_class)
    self.publishers = ()  # URIs, as the master last said
    # those of them that the last attempt to connect to has not reached
    self.out_of_reach = set()
    self.refused = {}  # URI of each that was refused -> what was said, the Refusal once it is known


@patch(
    'rospy.topics', '_SubscriberImpl.receive_callback', 'runs a callback for each message at once'
)
def receive_callback(self, msgs, connection, *, node, original):
    """Run the delegates after the batch: channels only queue in their callbacks, so that of a
    batch the newest are kept, and counts. The queue_size of a plain Subscriber is for the others.
    """
    limit = self.queue_size or len(msgs)
    for message in msgs[:-limit]:
        for callback, arguments in self.callbacks or ():
            if isinstance(callback, SocketCallback):
                self._invoke_callback(message, callback, arguments)
    original(self, msgs[-limit:], connection)
    node.on_received()


@patch(
    'rospy.topics',
    '_SubscriberImpl._invoke_callback',
    'loses a message for other callbacks, and those after it, for what is raised and no Exception',
)
def _invoke_callback(self, msg, cb, cb_args, *, node, original):
    """Let a callback fail alone."""
    try:
        original(self, msg, cb, cb_args)
    except BaseException as error:
        if is_from_signal(error):
            raise
        node.module.logerr('bad callback: %s\n%s', cb, traceback.format_exc())


@patch(
    'rospy.topics',
    '_SubscriberImpl.remove_connection',
    'lets a link that broke go, though its publisher is there, or there again (ros_comm #851)',
)
def remove_connection(self, c, *, node, original):
    """Connect again soon, but to one who refused, or may not be talked to; later to one who has sent
    nothing that can be read."""
    original(self, c)
    if self.closed:
        return
    if not c.header:
        delay = registration.RETRY_DELAY if c.dest_address else None
    elif 'error' in c.header or getattr(c, 'is_given_up', False):
        delay = None
    else:
        is_senseless = getattr(c, 'is_unreadable', False) and not c.stat_num_msg
        delay = registration.RETRY_DELAY if is_senseless else RECONNECT_DELAY
    if delay is not None:
        node.connections.connect_later(self, c.endpoint_id, delay)


@patch('rospy.topics', '_SubscriberImpl.add_callback', 'knows nothing of links and their inboxes')
def add_callback(self, cb, cb_args, *, original):
    """Links have inboxes for channels and one for all other callbacks, and know what was
    latched."""
    original(self, cb, cb_args)
    self.limit_reading()
    for link in links_of(self.connections):
        for message in link.callback_added(cb):
            self._invoke_callback(message, cb, cb_args)


@patch('rospy.topics', '_SubscriberImpl.remove_callback', 'knows nothing of links')
def remove_callback(self, cb, cb_args, *, original):
    """Tell the links."""
    original(self, cb, cb_args)
    self.limit_reading()
    for link in links_of(self.connections):
        link.callback_removed()


@addition('rospy.topics', '_SubscriberImpl.limit_reading', 'connections are read by it')
def limit_reading(self):
    """Have queue_size cut what is read from sockets only where no channel is to get it."""
    is_heard = any(isinstance(callback, SocketCallback) for callback, _ in self.callbacks or ())
    for connection in self.connections or ():
        protocol = getattr(connection, 'protocol', None)
        if protocol is not None:
            protocol.queue_size = None if is_heard else self.queue_size


@addition('rospy.topics', '_SubscriberImpl.run_callbacks', 'links call it')
def run_callbacks(self, message):
    """Run the callbacks that are no channels' for a message of a link."""
    for callback, arguments in plain_callbacks(self):
        self._invoke_callback(message, callback, arguments)


@substitute('rospy.topics', 'Poller', 'has a descriptor for each topic, which runs out with many')
def poller():
    """Look at the sockets without one."""
    return _Poller


class _Poller:
    """Finds sockets whose peers have left; any thread may call it."""

    def __init__(self):
        self._watched = set()  # descriptors
        self.add_fd, self.remove_fd = self._watched.add, self._watched.discard

    def error_iter(self):
        """The descriptors of those sockets."""
        if not self._watched:
            return
        poll = select.poll()
        for descriptor in tuple(self._watched):
            poll.register(descriptor, LEFT)
        for descriptor, event in poll.poll(0):
            if event & select.POLLNVAL:  # it was closed
                self._watched.discard(descriptor)
            else:
                yield descriptor
