"""What a process listens on, and peers that accept connections and say nothing."""
import contextlib
import os
import select
import socket
import struct

from rosgraph.network import encode_ros_handshake_header

LISTEN = '0A'  # the state, in /proc/net/tcp
_refusing = []  # sockets that have a port and do not listen


def listening(pid='self'):
    """``{(address, port)}`` of the TCP sockets on which the process listens."""
    return {local for state, local, _ in _tcp_sockets(pid) if state == LISTEN}


def connections_to_port(port):
    """How many connections to that port this process has open."""
    return sum(remote[1] == port for _, _, remote in _tcp_sockets('self'))


def _tcp_sockets(pid):
    """``[(state, local, remote)]`` of those that the process has open: the system's table has those
    of others, too, among which a port may come again."""
    inodes = set()
    for descriptor in os.listdir(f'/proc/{pid}/fd'):
        with contextlib.suppress(OSError):
            link = os.readlink(f'/proc/{pid}/fd/{descriptor}')
            if link.startswith('socket:'):
                inodes.add(link[len('socket:[') : -1])
    found = {}
    for table, family in ('tcp', socket.AF_INET), ('tcp6', socket.AF_INET6):
        with open(f'/proc/{pid}/net/{table}') as file:
            for line in list(file)[1:]:
                _, local, remote, state, *rest = line.split()
                if rest[5] in inodes:
                    found[rest[5]] = state, _address(local, family), _address(remote, family)
    return list(found.values())


def _address(text, family):
    """``(address, port)`` as the system's table has it."""
    address, port = text.split(':')
    words = struct.iter_unpack('=I', bytes.fromhex(address))
    packed = b''.join(struct.pack('>I', word) for word, in words)
    return socket.inet_ntop(family, packed), int(port, 16)


@contextlib.contextmanager
def silent_peer():
    """The URL of something that accepts connections and never answers."""
    with socket.socket() as listener:
        listener.bind(('127.0.0.1', 0))
        listener.listen()
        yield _url(listener)


def refused_url():
    """A URL at which nobody listens, as long as this process runs."""
    _refusing.append(_bound())
    return _url(_refusing[-1])


def unused_url():
    """A URL at which nobody listens yet."""
    with _bound() as free:
        return _url(free)


def _bound():
    bound = socket.socket()
    bound.bind(('127.0.0.1', 0))
    return bound


def _url(bound):
    return 'http://127.0.0.1:%d/' % bound.getsockname()[1]


def wait_for_end(pid, timeout):
    """Wait until the process has ended, whoever's child it is; returns whether it has."""
    try:
        descriptor = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([descriptor], [], [], timeout)[0])
    finally:
        os.close(descriptor)


def subscribe(port, topic, name='/raw'):
    """A subscriber of no client library: its socket, on which a connection header and messages will
    come."""
    sock = socket.socket()
    # little more goes to who does not read
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 16)
    sock.settimeout(20)
    sock.connect(('127.0.0.1', port))
    sock.sendall(
        encode_ros_handshake_header(
            {'callerid': name, 'topic': topic, 'type': '*', 'md5sum': '*', 'tcp_nodelay': '0'}
        )
    )
    return sock
