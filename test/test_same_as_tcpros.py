"""What a delegate gets through INTRAPROCESS is what it gets through TCPROS, by a connection of its
own or a shared one; what one refuses, the others do too."""
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helpers import speak_tcpros_only
from pharos.testing import Mailbox, TIMEOUT
import pharos
from pharos import BlockNode, Master
from test_copier import CLASSES, messages, told

pytestmark = pytest.mark.filterwarnings('ignore')  # numpy warns of some of the wrong values


def send(channel, message, mailbox):
    """What arrives, or the error that it raises at the publisher instead."""
    try:
        channel.publish(message)
    except pharos.MessageTypeError as error:
        return type(error)
    return mailbox.next()


@pytest.mark.parametrize('message_class', CLASSES, ids=lambda cls: cls._type)
def test_a_message_arrives_alike(master, message_class):
    sharing = Master(master.url, share_connections=True)
    sender, receiver, remote = (
        master.create(BlockNode, named=name, domain='127.0.0.1')
        for name in ('/sender', '/receiver', '/remote')
    )
    sharer = sharing.create(BlockNode, named='/sharer', domain='127.0.0.1')
    boxes, channels = [], []
    for node, transport in (receiver, 'INTRAPROCESS'), (remote, 'TCPROS'), (sharer, 'TCPROS'):
        if transport == 'TCPROS':
            speak_tcpros_only(node)
        boxes.append(Mailbox())
        node.interested_in(f'/to{node.name}', message_class, delegate=boxes[-1])
        channels.append(sender.output_channel(f'/to{node.name}', message_class))
        assert channels[-1].wait_for_subscribers(1, TIMEOUT)
        assert channels[-1].connections == [(node.name, transport)]

    @settings(
        max_examples=10, deadline=None, suppress_health_check=list(HealthCheck), database=None
    )
    @given(st.booleans().flatmap(lambda wrong: messages(message_class, wrong)))
    def arrives_alike(message):
        ours, *others = [send(*ends) for ends in zip(channels, [message] * 3, boxes)]
        if not isinstance(ours, type):
            del ours._connection_header  # which name different topics
        for theirs in others:
            if isinstance(ours, type) or isinstance(theirs, type):
                assert ours is theirs
            else:
                del theirs._connection_header
                assert told(ours) == told(theirs)

    arrives_alike()
