"""Random programs of plain rospy calls and channel calls see the same through INTRAPROCESS and
through TCPROS."""
import collections
import itertools
import threading

import geometry_msgs.msg
import pytest
import rospy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helpers import create, ended, in_thread, speak_tcpros_only
from pharos.channel import Channel
from pharos.intraprocess.link import links_of
from pharos.private_rospy.plain_receivers import PlainCallbacks
from pharos.testing import Mailbox, TIMEOUT, until
from test_copier import told

POINT = geometry_msgs.msg.PointStamped
topics = map('/program{}'.format, itertools.count())


class Receiver:
    """A channel or a plain subscription, and what it gets."""

    def __init__(self, expected):
        self.got, self.expected = [], expected  # messages, and how many are to come
        self.endpoint = None  # while it is open
        self._arrived = threading.Condition()

    def __call__(self, message, *_):
        fields = [told(getattr(message, name)) for name in message.__slots__]
        with self._arrived:
            self.got.append((type(message), fields, message._connection_header))
            self._arrived.notify_all()

    def wait(self):
        """Wait until all has come."""
        with self._arrived:
            is_all = self._arrived.wait_for(lambda: len(self.got) >= self.expected, TIMEOUT)
            assert is_all, f'{len(self.got)} of {self.expected}: {[got[1] for got in self.got]}'

    def by_sender(self):
        """What came, from each node; which of two comes first is nobody's promise."""
        senders = collections.defaultdict(list)
        for kind, fields, header in self.got:
            senders[header['callerid']].append((kind, fields, header))
        return dict(senders)


class Program:
    """One run of a program, on a topic of its own: two nodes publish, one receives.

    Each step waits until all has come that it is to bring about.
    """

    def __init__(self, senders, node, transport):
        self.topic = next(topics)
        self.senders, self.node, self.transport = senders, node, transport
        self.said = []  # what calls returned or raised
        self.receivers = []
        self._published = 0
        self._publishers = {}  # sender -> (endpoint, whether it latches)
        self._latched = {}  # sender -> whether it holds a message

    # -- steps

    def advertise(self, who, is_channel, latch, queue_size):
        """Open a sender's publisher, if it has none."""
        if who in self._publishers:
            return
        node = self.senders[who]
        if is_channel:
            endpoint = node.output_channel(self.topic, POINT, latch=latch, queue_size=100)
        else:
            endpoint = node.ros.Publisher(self.topic, POINT, latch=latch, queue_size=queue_size)
        self._publishers[who] = endpoint, latch
        self._settle()

    def unadvertise(self, who):
        """Close a sender's publisher; what it latched goes with it."""
        if who in self._publishers:
            self._latched.pop(who, None)
            close(self._publishers.pop(who)[0])
            self._settle()

    def subscribe(self, kind, queue_size):
        """Open a receiver."""
        receiver = Receiver(len(self._latched))
        self.receivers.append(receiver)
        ros = self.node.ros
        if kind == 'channel':
            receiver.endpoint = self.node.interested_in(
                self.topic, POINT, delegate=receiver, queue_size=100
            )
        elif kind == 'arguments':
            receiver.endpoint = ros.Subscriber(self.topic, POINT, receiver, 'arguments')
        else:
            receiver.endpoint = ros.Subscriber(self.topic, POINT, receiver, queue_size=queue_size)
        self._settle()

    def unsubscribe(self, index):
        """Close a receiver."""
        if self._open():
            receiver = self._open()[index % len(self._open())]
            close(receiver.endpoint)
            receiver.endpoint = None
            self._settle()

    def publish(self, who, count):
        """Publish some messages."""
        if who in self._publishers:
            endpoint, latch = self._publishers[who]
            for _ in range(count):
                self._published += 1
                message = POINT()
                message.header.frame_id = str(self._published)
                message.point.x = self._published
                endpoint.publish(message)
            if latch:
                self._latched[who] = True
            for receiver in self._open():
                receiver.expected += count
            self._settle()

    def publish_misfit(self, who):
        """Publish what does not serialize."""
        if who in self._publishers:
            message = POINT()
            message.point.x = 'far'
            try:
                self.said.append(self._publishers[who][0].publish(message))  # with nobody there
            except rospy.ROSException as error:
                self.said.append(type(error))

    def wait_for_message(self, who):
        """Wait for a message beside the receivers."""
        if who not in self._publishers or self._latched:
            return
        got = Mailbox()
        thread = in_thread(
            lambda: got(self.node.ros.wait_for_message(self.topic, POINT, TIMEOUT), None)
        )
        until(lambda: self._callbacks() == len(self._open()) + 1)
        self._settle(subscribers=1)
        for link in links_of(self._subscription().connections):
            until(lambda: any(isinstance(inbox, PlainCallbacks) for inbox in link.inboxes))
        self.publish(who, 1)
        self.said.append(got.next().header.frame_id)
        assert ended(thread)
        self._settle()

    def end(self):
        """Send one more message each, which comes last; returns all that was seen."""
        for who in range(len(self.senders)):
            self.unadvertise(who)
            self.advertise(who, False, False, 10)
            self.publish(who, 1)
            self.unadvertise(who)
        while self._open():
            self.unsubscribe(0)
        return self.said, [receiver.by_sender() for receiver in self.receivers]

    # -- what they wait for

    def _open(self):
        return [receiver for receiver in self.receivers if receiver.endpoint]

    def _subscription(self):
        return self.node.latest_run.rospy.subscriber(self.topic)

    def _callbacks(self):
        subscription = self._subscription()
        return len(subscription and subscription.callbacks or ())

    def _settle(self, subscribers=0):
        subscribers = subscribers or min(1, len(self._open()))
        for who in self._publishers:
            publisher = self.senders[who].latest_run.rospy.publisher(self.topic)
            until(lambda: len(publisher.connections) == subscribers)
        if subscribers:
            until(lambda: len(self._subscription().connections) == len(self._publishers))
            for connection in self._subscription().connections:
                assert connection.transport_type == self.transport
        for receiver in self.receivers:
            receiver.wait()


def close(endpoint):
    """Close a channel, or a plain Publisher or Subscriber."""
    (endpoint.close if isinstance(endpoint, Channel) else endpoint.unregister)()


who = st.integers(0, 1)
steps = st.one_of(
    st.tuples(st.just('publish'), who, st.integers(1, 3)),
    st.tuples(
        st.just('subscribe'),
        st.sampled_from(['plain', 'arguments', 'channel']),
        st.sampled_from([None, 100]),
    ),
    st.tuples(
        st.just('advertise'), who, st.booleans(), st.booleans(), st.sampled_from([None, 100])
    ),
    st.tuples(st.just('unsubscribe'), st.integers(0, 5)),
    st.tuples(st.just('unadvertise'), who),
    st.tuples(st.just('publish_misfit'), who),
    st.tuples(st.just('wait_for_message'), who),
)


def without_topic(seen, program):
    """What was seen, comparable with that of a program on another topic."""
    said, receivers = seen
    for received in receivers:
        for messages in received.values():
            for _, _, header in messages:
                assert header['topic'] == program.topic
    return said, [
        {
            name: [(kind, fields, {**header, 'topic': ''}) for kind, fields, header in messages]
            for name, messages in received.items()
        }
        for received in receivers
    ]


def differences(one, other):
    """Where two differ in what was seen, in few words."""
    said = [('said', one[0], other[0])] if one[0] != other[0] else []
    for number, (received, here) in enumerate(zip(one[1], other[1])):
        for sender in sorted({*received, *here}):
            both = received.get(sender, []), here.get(sender, [])
            if both[0] != both[1]:
                told = (
                    [[fields, *sorted(header.items())] for _, fields, header in each]
                    for each in both
                )
                said.append((f'receiver {number} of {sender}', *told))
    return '\n'.join(map(str, said))


@pytest.mark.filterwarnings('ignore:The publisher should be created')
def test_a_program_sees_the_same_through_both_transports(master):
    senders = [create(master, name) for name in ('/one', '/two')]
    here, there = create(master, '/here'), speak_tcpros_only(create(master, '/there'))
    ways = (here, 'INTRAPROCESS'), (there, 'TCPROS')

    @settings(
        max_examples=30, deadline=None, suppress_health_check=list(HealthCheck), database=None
    )
    @given(st.lists(steps, min_size=4, max_size=16))
    def sees_the_same(steps):
        seen = []
        for node, transport in ways:
            program = Program(senders, node, transport)
            for name, *arguments in steps:
                getattr(program, name)(*arguments)
            seen.append(without_topic(program.end(), program))
        assert seen[0] == seen[1], differences(*seen)

    sees_the_same()
