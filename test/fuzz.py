"""Clients that say anything: handshakes and XML-RPC calls that are nearly right, made from a
seed."""
import contextlib
import random
import socket
import struct
import xmlrpc.client

TIMEOUT = (
    20.0  # seconds in which a node closes a connection whose client has said all it has to say
)
HANGING = 40  # clients that stay at a time, and say no more

# 'shutdown' is not among them: a node obeys that, from its own host
METHODS = (
    'getPid getName getUri getBusInfo getBusStats getMasterUri getSubscriptions getPublications paramUpdate '
    'publisherUpdate requestTopic system.multicall system.listMethods _shutdown __init__ reg_man.cleanup name '
    'remappings protocol_handlers nothing'
).split()
NAMES = [
    '',
    '/',
    '~',
    '/fuzz',
    '/fuzz/',
    '//',
    'fuzz',
    '/%s%n%(x)s',
    '/{0.__class__}',
    '/../../tmp/fuzz',
    '/a\nb',
    '/a b',
    '/\u202e\u00e9\u4e16',
    '/' + 'a' * 5000,
    '\x7f',
    ':',
    '/<a>&amp;',
]


class Fuzz:
    """A source of bad clients for one node; two of the same seed are the same.

    :param topics: ``[(topic, type, md5sum)]`` that the node publishes
    :param services: ``[(service, md5sum)]`` that it offers
    """

    def __init__(self, seed, topics=(), services=()):
        self.seed = seed
        self._random = random.Random(seed)
        self._topics, self._services = list(topics), list(services)

    # -- TCPROS

    def handshake(self):
        """The bytes of a connection header, and perhaps more."""
        some = self._random
        fields = {'callerid': '/fuzz'}
        if self._services and some.random() < 0.4:
            fields['service'], fields['md5sum'] = some.choice(self._services)
            fields['persistent'] = some.choice(['0', '1', 'true', ''])
        elif self._topics:
            fields['topic'], fields['type'], fields['md5sum'] = some.choice(self._topics)
            fields['tcp_nodelay'] = some.choice(['0', '1', ''])
        for _ in range(some.choice([0, 0, 1, 1, 2])):
            field = some.choice([*fields, 'probe', 'latching', 'error', ''])
            if some.random() < 0.3:
                fields.pop(field, None)
            else:
                fields[field] = some.choice([*NAMES, '*', '0', '1'])
        lines = [('%s=%s' % item).encode() for item in fields.items()]
        if some.random() < 0.2:
            lines.insert(
                some.randrange(len(lines) + 1),
                some.choice([b'', b'=', b'no sign', b'\xff\xfe=\x00']),
            )
        body = b''.join(struct.pack('<I', self._length(len(line))) + line for line in lines)
        data = struct.pack('<I', self._length(len(body))) + body
        if some.random() < 0.3:  # a service's request, or what a subscriber has no reason to say
            data += struct.pack('<I', self._length(8)) + some.randbytes(some.choice([0, 1, 8, 100]))
        return self._mutated(data)

    def _length(self, right):
        if self._random.random() < 0.93:
            return right
        return self._random.choice(
            [0, 1, right - 1, right + 1, 1000, 0x7FFFFFFF, 0xFFFFFFFB, 0xFFFFFFFF]
        ) % (1 << 32)

    # -- XML-RPC

    def request(self):
        """The bytes of an HTTP request, or two."""
        some = self._random
        parameters = tuple(self._value() for _ in range(some.choice([0, 1, 1, 2, 3, 3, 4])))
        if parameters and some.random() < 0.7:
            parameters = '/fuzz', *parameters[1:]
        body = xmlrpc.client.dumps(parameters, some.choice(METHODS), allow_none=True).encode(
            errors='replace'
        )
        if some.random() < 0.4:
            body = self._mutated(body)
        elif some.random() < 0.1:
            body = some.choice(
                [
                    b'',
                    b'<a/>',
                    b'<methodCall/>',
                    b'<methodResponse/>',
                    b'\0' * 100,
                    b'<value>' * 5000,
                    b'<!DOCTYPE x [<!ENTITY a "b">]><methodCall>&a;</methodCall>',
                    body[:-5],
                    body + body,
                ]
            )
        method = some.choice(['POST'] * 20 + ['GET', 'PUT', 'post', ''])
        path = some.choice(['/'] * 10 + ['/RPC2', '/nothing', '*', ''])
        version = some.choice(['HTTP/1.1'] * 10 + ['HTTP/1.0', 'HTTP/9.9', 'HTTP', ''])
        head = [f'{method} {path} {version}']
        if some.random() < 0.95:
            length = some.choice(
                [str(len(body))] * 15
                + ['-1', '', 'x', '1e3', str(len(body) + 9), '1', '99999999999']
            )
            head.append('Content-Length: ' + length)
        if some.random() < 0.2:
            head.append(
                some.choice(
                    [
                        'Transfer-Encoding: chunked',
                        'Content-Encoding: gzip',
                        'Connection: close',
                        ': x',
                        'Expect: 100-continue',
                        'no colon',
                        'X: ' + 'y' * 70000,
                        'X: y\r\n' * 200,
                    ]
                )
            )
        data = '\r\n'.join(head).encode() + b'\r\n\r\n' + body
        if some.random() < 0.1:
            data = self._mutated(data)
        return data * some.choice([1, 1, 1, 2])

    def _value(self, depth=0):
        some = self._random
        kind = some.randrange(9 if depth < 3 else 7)
        if kind == 7:
            return [self._value(depth + 1) for _ in range(some.randrange(4))]
        if kind == 8:
            return {some.choice(NAMES): self._value(depth + 1) for _ in range(some.randrange(3))}
        return [
            some.choice(NAMES),
            '/fuzz',
            some.choice([0, -1, 1 << 31 - 1, True]),
            some.choice([0.0, float('nan'), float('inf')]),
            None,
            xmlrpc.client.Binary(b'\0\xff'),
            some.choice(
                [[['TCPROS']], [], [[]], ['http://127.0.0.1:1/'], ['http://['], 'x' * 100000]
            ),
        ][kind]

    # -- both

    def _mutated(self, data):
        """The bytes, some of them changed, in four cases of ten."""
        some = self._random
        if some.random() < 0.6:
            return data
        data = bytearray(data)
        for _ in range(some.choice([1, 1, 2, 5])):
            begin = some.randrange(len(data) + 1)
            end = min(len(data), begin + some.choice([1, 1, 4, 20]))
            data[begin:end] = some.choice(
                [b'', b'\0', b'\xff' * 4, some.randbytes(4), data[begin:end] * 2, b'\r\n']
            )
        if some.random() < 0.2:
            del data[some.randrange(len(data) + 1) :]
        return bytes(data)

    def attack(self, tcp_port, xmlrpc_port, count):
        """Connect ``count`` times, say something each time, and go in one way or another.

        :raises AssertionError: if the node keeps a connection open whose client has said all it has
            to say
        """
        some, hanging = self._random, []
        with contextlib.ExitStack() as all_of_them:
            for number in range(count):
                to_tcpros = some.random() < 0.5
                data = self.handshake() if to_tcpros else self.request()
                client = all_of_them.enter_context(
                    socket.create_connection(
                        ('127.0.0.1', tcp_port if to_tcpros else xmlrpc_port), TIMEOUT
                    )
                )
                with contextlib.suppress(ConnectionError):  # closed before all was said
                    client.sendall(data)
                way = some.random()
                if way < 0.1:  # stay, and say no more
                    hanging.append(client)
                    if len(hanging) > HANGING:
                        hanging.pop(0).close()
                    continue
                if way < 0.3:  # break off
                    client.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack('ii', 1, 0))
                elif way < 0.8 and not to_tcpros:  # there, who is let in may stay, as a subscriber
                    self._hear_out(client, number, data)
                client.close()

    def _hear_out(self, client, number, data):
        with contextlib.suppress(ConnectionError):
            try:
                client.shutdown(socket.SHUT_WR)
                while client.recv(1 << 16):
                    pass
            except OSError as error:
                if not isinstance(error, socket.timeout):  # it has closed it already
                    return
                raise AssertionError(
                    'seed %r: the node does not close connection %d, which said %r'
                    % (self.seed, number, data[:500])
                ) from None
