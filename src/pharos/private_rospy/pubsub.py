"""What a node publishes and hears: mended where rospy loses messages or links."""
import time
import traceback

from pharos.private_rospy import refusals, registration
from pharos.intraprocess.callbacks import is_of_channel
from pharos.intraprocess.fanout import links_of
from pharos.intraprocess.link import protocol_handler
from pharos.private_rospy.lifetime import keep_alive
from pharos.private_rospy.publishing import mend_publisher, notify
from pharos.signals import is_from_signal

RECONNECT_DELAY = 0.05  # seconds; a publisher that accepts and closes at once is not to be stormed
CONNECT_TIMEOUT = 10.0  # seconds that one attempt may take


def hooks(instance):
    """The load hooks of this module, for the :class:`~.instance.PrivateRospy` given."""

    def mend_topics(module):
        """rospy.topics."""
        module.is_shutdown = instance.is_shut_down
        _close_pollers(module._TopicImpl)
        mend_publisher(module, instance.start_thread)
        _mend_subscriber(module._SubscriberImpl, instance)

    def offer_intraprocess(module):
        """rospy.impl.masterslave: of the protocols that a node supports, the first that its peer
        does too is taken."""
        handler = module.ROSHandler
        init = handler.__init__

        def __init__(self, *args):
            init(self, *args)
            self.protocol_handlers.insert(0, protocol_handler(instance))

        handler.__init__ = __init__

        def _ready(self, uri):
            """Who hears of the node from the master, as soon as it registers, is to find it
            here."""
            instance.uri = uri
            instance.connections.open()
            ready(self, uri)

        ready, handler._ready = handler._ready, _ready

    def notice_silence(module):
        """rospy.impl.tcpros_base: takes 150 s to notice that a peer has gone, and cannot connect
        without the master."""
        transport, is_wanted = module.TCPROSTransport, module._is_use_tcp_keepalive
        connect = transport.connect

        def is_keepalive_wanted():
            try:
                return is_wanted()  # asks the master for the parameter /tcp_keepalive, once
            except registration.COMMUNICATION_ERRORS:
                return True

        module._is_use_tcp_keepalive = is_keepalive_wanted

        def connect_kept_alive(self, *address, timeout=None):
            connect(self, *address, timeout=timeout)
            sock = self.socket
            if sock is None:  # closed meanwhile
                return
            instance.track_socket(sock)  # a call of a service waits for its answer for ever
            if is_keepalive_wanted():
                keep_alive(sock)

        transport.connect = connect_kept_alive

    def connect_once(module):
        """rospy.impl.tcpros_pubsub: after a failure, rospy gives up silently, or waits for what it
        never connected."""

        def connect(connection, host, port, uri, receive, topic):
            wanted = connection.protocol.recv_data_class
            try:
                connection.connect(host, port, uri, timeout=CONNECT_TIMEOUT)
                refusals.check_md5sum(connection, wanted)
            except module.rospy.exceptions.TransportInitError:
                connection.close()  # remove_connection then sees to the next attempt
                refusals.examine(instance, connection, topic, uri)
            else:
                instance.refusals.publisher_connected(topic, uri)
                connection.is_heard = True
                notify()
                connection.receive_loop(receive)

        module.robust_connect_subscriber = connect

    def send_at_once(module):
        """rospy.impl.tcpros_pubsub: a subscriber that does not ask for TCP_NODELAY gets some
        messages 40 ms late.

        rospy's and roscpp's do not, by default (ros_comm #1362, #2318).
        """
        configure = module._configure_pub_socket
        module._configure_pub_socket = lambda sock, is_tcp_nodelay: configure(sock, True)

    def mend_tcpros(module):
        connect_once(module)
        send_at_once(module)

    return {
        'rospy.topics': mend_topics,
        'rospy.impl.masterslave': offer_intraprocess,
        'rospy.impl.tcpros_base': notice_silence,
        'rospy.impl.tcpros_pubsub': mend_tcpros,
    }


def _close_pollers(topic):
    """rospy.topics._TopicImpl: a closed topic keeps its epoll descriptor until the cycle collector
    comes."""
    close = topic.close

    def close_all(self):
        close(self)
        self.connection_poll.poller.close()

    topic.close = close_all


def _mend_subscriber(subscriber, instance):
    """rospy.topics._SubscriberImpl."""
    receive, remove = subscriber.receive_callback, subscriber.remove_connection
    add, discard = subscriber.add_callback, subscriber.remove_callback
    subscriber.publishers = ()  # URIs, as the master last said
    init = subscriber.__init__

    def __init__(self, *args, **kwargs):
        init(self, *args, **kwargs)
        # those of them that the last attempt to connect to has not reached
        self.out_of_reach = set()

    subscriber.__init__ = __init__

    def receive_callback(self, messages, connection):
        """Channels only queue in their callbacks, so that of a batch the newest are kept; delegates
        run then."""
        receive(self, messages, connection)
        instance.on_received()

    subscriber.receive_callback = receive_callback

    invoke = subscriber._invoke_callback

    def _invoke_callback(self, message, callback, arguments):
        """Where a callback raises what is no Exception, rospy loses it for the other callbacks, and
        those after it."""
        try:
            invoke(self, message, callback, arguments)
        except BaseException as error:
            if is_from_signal(error):
                raise
            instance.rospy.logerr('bad callback: %s\n%s', callback, traceback.format_exc())

    subscriber._invoke_callback = _invoke_callback

    def remove_connection(self, connection):
        """rospy lets a link that broke go, though its publisher may be there, or there again under
        its old URI.

        A link that was lost for long never came back (ros_comm #851).
        """
        remove(self, connection)
        if self.closed:
            return
        if connection.header:
            delay = None if 'error' in connection.header else RECONNECT_DELAY
        else:
            delay = registration.RETRY_DELAY if connection.dest_address else None
        # None: the publisher refused, or may not be talked to, and so it stays
        if delay is not None:
            instance.start_thread(
                _reconnect, (instance, self, connection.endpoint_id, delay), 'reconnect'
            )

    subscriber.remove_connection = remove_connection

    def add_callback(self, callback, arguments):
        """Links have inboxes for channels and one for all other callbacks, and know what was
        latched."""
        add(self, callback, arguments)
        for link in links_of(self.connections or ()):
            for message in link.callback_added(callback):
                self._invoke_callback(message, callback, arguments)

    subscriber.add_callback = add_callback

    def remove_callback(self, callback, arguments):
        discard(self, callback, arguments)
        for link in links_of(self.connections or ()):
            link.callback_removed()

    subscriber.remove_callback = remove_callback

    def has_plain_callbacks(self):
        return not all(is_of_channel(callback) for callback, _ in self.callbacks or ())

    subscriber.has_plain_callbacks = has_plain_callbacks

    def run_callbacks(self, message):
        """Run the callbacks that are no channels' for a message of a link."""
        for callback, arguments in self.callbacks or ():
            if not is_of_channel(callback):
                self._invoke_callback(message, callback, arguments)

    subscriber.run_callbacks = run_callbacks


def _reconnect(instance, subscriber, uri, delay):
    if not instance.ended.wait(delay) and not subscriber.closed:
        instance.connect(subscriber.resolved_name, uri)


def flush(topic_manager, timeout):
    """Wait until what the node published is with the sockets, up to ``timeout`` seconds in all."""
    deadline = time.monotonic() + timeout
    for publisher in list(topic_manager.pubs.values()):
        for connection in list(publisher.connections):
            if hasattr(connection, 'flush'):
                connection.flush(deadline - time.monotonic())
