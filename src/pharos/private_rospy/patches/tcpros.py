"""TCPROS connections: made once and in time, and noticed when they are dead."""
import rosgraph.network

from pharos.private_rospy import refusals
from pharos.private_rospy.acceptor import brief
from pharos.private_rospy.lifetime import keep_alive
from pharos.private_rospy.patches.table import patch
from pharos.private_rospy.changes import notify
from pharos.private_rospy.registration import COMMUNICATION_ERRORS
from pharos.private_rospy.tcpros_connection import CALLER_ID

CONNECT_TIMEOUT = 10.0  # seconds that one attempt may take


@patch('rospy.impl.tcpros_base', '_is_use_tcp_keepalive', 'cannot connect without the master')
def _is_use_tcp_keepalive(*, original):
    """Keep alive where nobody can be asked."""
    try:
        return original()  # asks the master for the parameter /tcp_keepalive, once
    except COMMUNICATION_ERRORS:
        return True


@patch(
    'rospy.impl.tcpros_base',
    'TCPROSTransport.connect',
    'takes 150 s to notice that its peer has gone, and its wait for an answer ends with nothing',
)
def connect(self, dest_addr, dest_port, endpoint_id, timeout=None, *, node, original, module):
    """Keep the connection alive, and shut it down when the node stops."""
    original(self, dest_addr, dest_port, endpoint_id, timeout=timeout)
    sock = self.socket
    if sock is None:  # closed meanwhile
        return
    node.lifetime.track_socket(sock)  # a call of a service waits for its answer for ever
    if module._is_use_tcp_keepalive():
        keep_alive(sock)


@patch(
    'rospy.impl.tcpros_pubsub',
    'robust_connect_subscriber',
    'gives up silently after a failure, or waits for what it never connected',
)
def robust_connect_subscriber(
    conn, dest_addr, dest_port, pub_uri, receive_cb, resolved_topic_name, *, node, module
):
    """Try once: remove_connection sees to the next attempt."""
    protocol = conn.protocol
    if protocol is None:  # closed already, as the node stops
        return
    try:
        conn.connect(dest_addr, dest_port, pub_uri, timeout=CONNECT_TIMEOUT)
        refusals.check_md5sum(conn, protocol.recv_data_class)
    except module.rospy.exceptions.TransportInitError:
        conn.is_unreadable = True  # if it has answered, and not refused
        conn.close()
        refusals.examine(node, conn, resolved_topic_name, pub_uri)
    else:
        node.refusals.publisher_connected(resolved_topic_name, pub_uri)
        conn.is_heard = True
        notify()
        subscriber = node.subscriber(resolved_topic_name)
        if subscriber is not None:
            subscriber.limit_reading()
        with node.connections.reading(resolved_topic_name):
            conn.receive_loop(receive_cb)


@patch(
    'rospy.impl.tcpros_pubsub',
    '_configure_pub_socket',
    'sends some messages 40 ms late to a subscriber that does not ask for TCP_NODELAY, which'
    ' rospy and roscpp by default do not (ros_comm #1362, #2318)',
)
def _configure_pub_socket(sock, is_tcp_nodelay, *, original):
    """Send at once to all."""
    original(sock, True)


@patch(
    'rospy.impl.tcpros_pubsub',
    'TCPROSHandler.topic_connection_handler',
    'tells the log of a subscriber of another type, or nobody, and does not always name the topic',
)
def topic_connection_handler(self, sock, client_addr, header, *, node, original):
    """Tell of each subscriber that is refused once."""
    topic, name = header['topic'], header.get('callerid')
    asked_for = node.publisher(topic) if name == CALLER_ID else None
    # who only asks for the definition is no subscriber, and misses no message
    if asked_for is not None:
        rosgraph.network.write_ros_handshake_header(sock, node.connection_header(asked_for))
        sock.close()
        return None
    said = original(self, sock, client_addr, header)
    if not said:
        node.refusals.subscriber_connected(topic, name)
        return said
    publisher = node.publisher(topic)
    if (
        publisher is None
        or header.get('md5sum') in (None, publisher.data_class._md5sum)
        or name is None
    ):
        return said
    if topic not in said:
        said = f'{topic}: {said} ({name})'
    rosgraph.network.write_ros_handshake_header(sock, {'error': said})
    sock.close()
    line = f'TCPROS client {client_addr[0]}:{client_addr[1]} refused: {brief(said)}'
    node.refusals.subscriber_refused(publisher, name, said, line)
    return None
