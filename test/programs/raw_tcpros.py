"""TCPROS without a client library, and a node that misbehaves as a test asks."""
import contextlib
import os
import socket
import struct
import threading
import xmlrpc.server

import rosgraph
from rosgraph.network import encode_ros_handshake_header

STRING_MD5 = '992ce8a1687cec8c8bd883ec73ca41d1'  # of any type that is one string
LIMIT = 30  # seconds


def connect(port):
    """Return a socket that is connected to a port of this host."""
    sock = socket.socket()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)  # little fits in if nobody reads
    sock.settimeout(20)
    sock.connect(('127.0.0.1', port))
    return sock


def subscribe(port, topic, name='/raw'):
    """Return a socket on which a connection header and then messages will come."""
    sock = connect(port)
    fields = {'callerid': name, 'topic': topic, 'type': '*', 'md5sum': '*', 'tcp_nodelay': '0'}
    sock.sendall(encode_ros_handshake_header(fields))
    return sock


def receive(sock):
    """Return the next thing that comes: a connection header, or a message."""

    def exactly(size):
        data = b''
        while len(data) < size:
            more = sock.recv(size - len(data))
            if not more:
                raise EOFError('closed')
            data += more
        return data

    return exactly(*struct.unpack('<I', exactly(4)))


def text(message):
    """Return the string in a message that is one string."""
    return message[4:].decode()


def string_message(data):
    """Return the bytes of a message that is one string."""
    return struct.pack('<II', len(data) + 4, len(data)) + data.encode()


def leave(sock, until):
    """Close a connection, and wait until the other side can know."""
    sock.shutdown(socket.SHUT_WR)
    until(lambda: sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] != 4)  # FIN_WAIT1
    sock.close()


def is_without_delay(sock):
    """True if Nagle's algorithm is off."""
    return bool(sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY))


class FakeNode:
    """A node in this process without rospy: XML-RPC answers, and a TCPROS port if it listens."""

    def __init__(self, master, topic, type_='std_msgs/String', bus_info=(), name='/fake'):
        self.name, self.topic, self.type = name, topic, type_
        self.asked = threading.Semaphore(0)
        self._bind()
        self._refusing = socket.socket()
        self._refusing.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._server = xmlrpc.server.SimpleXMLRPCServer(('127.0.0.1', 0), logRequests=False)
        answers = {'publisherUpdate': 0, 'getPid': os.getpid(), 'getBusInfo': bus_info}
        for name, answer in answers.items():
            self._server.register_function(lambda *_, answer=answer: (1, '', answer), name)
        self._server.register_function(self._request_topic, 'requestTopic')
        self.uri = f'http://127.0.0.1:{self._server.server_address[1]}/'
        self.api = rosgraph.Master(self.name, master_uri=master.url)
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,))

    def _bind(self):
        self.listener = socket.socket()
        self.listener.bind(('127.0.0.1', 0))
        self.listener.settimeout(LIMIT)

    def close_port(self):
        """Refuse subscribers from here on."""
        with contextlib.suppress(OSError):
            self.listener.shutdown(socket.SHUT_RDWR)  # wakes a thread that accepts
        self.listener.close()

    def _request_topic(self, *_):
        self.asked.release()
        return 1, '', ('TCPROS', '127.0.0.1', self.listener.getsockname()[1])

    def accept(self):
        """Wait for the next subscriber, shake hands with it, and return the connection."""
        self.listener.listen()
        connection, _ = self.listener.accept()
        receive(connection)
        fields = {'callerid': self.name, 'topic': self.topic, 'md5sum': STRING_MD5}
        definition = {'type': self.type, 'message_definition': 'string data\n'}
        connection.sendall(encode_ros_handshake_header({**fields, **definition}))
        return connection

    def publish_here(self):
        """Tell the master that this node publishes the topic."""
        self.api.registerPublisher(self.topic, self.type, self.uri)
        return self

    def hear_here(self):
        """Tell the master that this node hears the topic; it never connects."""
        self.api.registerSubscriber(self.topic, self.type, self.uri)
        return self

    def move(self):
        """Take another port, at which nobody listens yet."""
        self.close_port()
        self._bind()

    @contextlib.contextmanager
    def sending(self, data):
        """Send this message to each subscriber that comes meanwhile."""

        def send():
            with contextlib.ExitStack() as connections, contextlib.suppress(OSError):
                while True:
                    connections.enter_context(self.accept()).sendall(string_message(data))

        thread = threading.Thread(target=send)
        thread.start()
        yield
        self.close_port()
        thread.join(LIMIT)

    def stop_answering(self):
        """Refuse questions from here on."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(LIMIT)
        # else another program may get the port; a second call finds it bound already
        with contextlib.suppress(OSError):
            self._refusing.bind(self._server.server_address)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *error):
        self.api.unregisterPublisher(self.topic, self.uri)
        self.api.unregisterSubscriber(self.topic, self.uri)
        self.stop_answering()
        self._refusing.close()
        self.close_port()
